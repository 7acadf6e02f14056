"""In front of PYTHONPATH this hides from every process the posix modules and `fork`, which Windows lacks."""

import multiprocessing
import os
import sys
import warnings

import psutil  # noqa: F401  its modules for Windows need none of them

for name in ("fcntl", "grp", "pwd", "resource", "termios", "tty", "pty", "syslog"):
    sys.modules[name] = None
for name in ("fork", "forkpty", "mkfifo", "geteuid", "getegid", "sched_getaffinity"):
    vars(os).pop(name, None)
warnings.filterwarnings("ignore", "only soft file lock is available")  # Windows has a lock of its own
multiprocessing.set_start_method("spawn")

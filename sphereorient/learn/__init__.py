"""The optional proposer: a network that says where a ball could point, and how it is trained.

`train`, `module` and `data` import pytorch_lightning, which takes seconds: only the command that trains imports them.
"""

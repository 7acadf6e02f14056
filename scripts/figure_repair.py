"""Make docs/repair.png and print its numbers: false stretches of two cameras, found between spikes and repaired."""

from pathlib import Path

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble import AssembleSettings, assemble_paths, fuse
from sphereorient.report.plots.style import new_figure
from sphereorient.search import Candidates
from sphereorient.synth.motion import random_motion
from sphereorient.trajectory import Reason

TIME_S = torch.arange(600, dtype=torch.float64) / 600.0
STRETCHES = {  # first frame: length; that of cam2 at 335 follows on that of cam1 at 320
    "cam1": {40: 1, 90: 3, 150: 8, 230: 30, 320: 15, 420: 9, 500: 20},
    "cam2": {60: 1, 120: 2, 190: 12, 270: 25, 335: 12, 395: 5, 450: 12, 550: 30},
}
UNSEEN = {"cam1": slice(447, 453), "cam2": slice(417, 423)}  # a false stretch of the other camera begins in it


def planted(seed: int) -> tuple[Tensor, dict[str, Candidates]]:
    """Return true orientations (N, 3, 3), rms omega of the paper, and 2 to 5 candidates a frame, wrong by 1 degree rms.
    A false stretch always has a candidate that rotates as smoothly, and the true one in every third frame.
    """
    rng = torch.Generator().manual_seed(seed)
    R, other = (random_motion(0.3, 0.05, 7.8, 0.05, 40.0, 2 * seed + k).at(TIME_S).R_lab_body for k in (0, 1))
    aside, cameras = so3.exp(torch.tensor([0.0, 0.0, 1.9], dtype=torch.float64)), {}
    for name, stretches in STRETCHES.items():
        every = so3.random_rotations((len(R), 5), generator=rng, dtype=torch.float64)  # true, false, and random
        there = torch.arange(5) < torch.randint(3, 6, (len(R), 1), generator=rng)
        every[:, 0], there[:, 1] = R, False
        for first, length in stretches.items():
            part = slice(first, first + length)
            every[part, 1], there[part, 1] = other[part] @ other[first].mT @ aside @ R[first], True
            there[part, 0] = torch.tensor([k % 3 == 1 and k < length - 1 for k in range(length)])
        there[UNSEEN[name]] = False
        T = torch.tensor([0.84] * 2 + [0.5] * 3) + 0.1 * torch.rand(len(R), 5, generator=rng, dtype=torch.float64)
        cameras[name] = Candidates(
            offset=torch.nn.functional.pad(there.sum(1).cumsum(0), (1, 0)),
            R_view_body=(so3.exp(0.01 * torch.randn(len(R), 5, 3, generator=rng, dtype=torch.float64)) @ every)[there],
            R_lab_view=torch.eye(3, dtype=torch.float64).expand(len(R), 3, 3),
            score=T[there],
            reason=tuple(Reason.OK if any(frame) else Reason.NOT_FOUND for frame in there.tolist()),
        )
    return R, cameras


def repaired(seed: int = 0, out: Path | None = None) -> dict[str, float]:
    """Return the numbers of a planted movie; draw it where a file is given."""
    (R, cameras), settings = planted(seed), AssembleSettings()
    paths = assemble_paths(cameras, TIME_S, settings)
    fused = fuse(paths, cameras, TIME_S, settings)
    figure, found, left, error = new_figure(11, 8), 0, [], so3.geodesic_distance(fused.R_lab_body, R).rad2deg()
    for (name, path), (top, low) in zip(paths.items(), figure.subplots(4, 1, sharex=True).reshape(2, 2), strict=True):
        both = torch.stack([path.R_lab_body, fused.R_lab_body_of[name]])
        before, after = so3.geodesic_distance(both, R).rad2deg()
        left.append(torch.stack([before > 30, (before > 30) & (after < 30), after > 30]).sum(1))
        found += sum(bool(path.spike[[first, first + length]].all()) for first, length in STRETCHES[name].items())
        frame = torch.arange(len(R)).repeat_interleave(cameras[name].offset.diff())
        every = so3.geodesic_distance(cameras[name].R_lab_body, R[frame]).rad2deg()
        top.plot(frame, every, ".", color="0.8", ms=2, label="candidates")
        top.plot(torch.where(before > 30, before, torch.nan), ".", color="#d55e00", label="path, false")
        top.plot(after, ".", color="#0072b2", ms=2, label="after the repair")
        top.set(ylabel=f"{name}: degrees\nfrom the truth", ylim=(-5, 235))
        low.semilogy(path.xi, color="0.4", lw=0.7)
        low.plot(torch.where(path.spike, path.xi, torch.nan), "v", color="#d55e00", ms=4, label="spikes")
        low.fill_between(range(len(R)), 1, 3e3, where=path.segment % 2 == 1, alpha=0.15, label="odd segments")
        low.set(xlabel="frame", ylabel=f"{name}: xi, rad/s", ylim=(1, 2e4), xlim=(-2, len(R) + 1))
        _ = top.legend(loc="upper right", ncols=3), low.legend(loc="upper right", ncols=3)
    false, replaced, remain = torch.stack(left).sum(0).tolist()
    if out:
        figure.savefig(out, dpi=90)
    return {
        "stretches planted": sum(map(len, STRETCHES.values())),
        "of them between two spikes": found,
        "false frames before": false,
        "of them replaced by a candidate near the truth": replaced,
        "of them dropped": false - replaced - remain,
        "false frames left": remain,
        "frames of the mean, of 600": int(error.isfinite().sum()),
        "rms error of the mean, degrees": round(float(error.square().nanmean().sqrt()), 2),
    }


if __name__ == "__main__":
    for what, number in repaired(out=Path(__file__).resolve().parents[1] / "docs" / "repair.png").items():
        print(f"| {what} | {number} |")

"""Balls that look alike keep their names by their motion; frames where names are uncertain are marked."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from sphereorient import so3
from sphereorient.assemble.identity import same_balls

FRAMES = 120
TIME_S = np.arange(FRAMES) / 600.0


def motions(balls: int, seed: int = 0):
    """Smooth paths and rotations of balls that start some mm apart, (K, N, 3) and (K, N, 3, 3)."""
    rng = np.random.default_rng(seed)
    t = TIME_S[:, None] * 2 * np.pi
    paths, turns = [], []
    for k in range(balls):
        a, b, c = rng.normal(size=(3, 3))
        paths.append(15.0 * k + 6 * a * np.sin(4 * t) + 6 * b * np.cos(3 * t))
        turn = torch.from_numpy(3 * a * np.sin(2 * t) + 3 * c * np.cos(3 * t))
        turns.append((so3.exp(turn) @ so3.random_rotations(1, generator=torch.Generator().manual_seed(k))).numpy())
    noise = rng.normal(scale=0.005, size=(balls, FRAMES, 3))
    return np.array(paths) + noise, np.array(turns)


def swapped(X, R, at):
    """The same with the rows of two balls exchanged from each of these frames on."""
    order = np.tile(np.arange(len(X))[:, None], (1, FRAMES))
    for frame in at:
        order[:2, frame:] = order[1::-1, frame:]
    rows = np.arange(FRAMES)
    return X[order, rows], R[order, rows], order


@pytest.mark.parametrize("at", [[], [64], [20, 64, 97]], ids=str)
def test_planted_swaps_are_undone_at_chunk_borders_and_at_jumps(at):
    X, R = motions(3)
    mixed_X, mixed_R, _ = swapped(X, R, at)
    order, sure = same_balls(mixed_X, mixed_R, np.ones((3, FRAMES), bool), TIME_S, [0, 64])
    rows = np.arange(FRAMES)
    np.testing.assert_array_equal(mixed_X[order, rows], X)
    np.testing.assert_array_equal(mixed_R[order, rows], R)
    assert np.isnan(sure).all()


def test_a_ball_that_was_hidden_for_some_frames_is_the_one_that_is_missing():
    X, R = motions(2)
    mixed_X, mixed_R, _ = swapped(X, R, [50])
    seen = np.ones((2, FRAMES), bool)
    seen[:, 42:50] = [[True], [False]]
    order, sure = same_balls(mixed_X, mixed_R, seen, TIME_S, [])
    for frame in (*range(42), *range(50, FRAMES)):
        np.testing.assert_array_equal(mixed_X[order[:, frame], frame], X[:, frame])
    assert (np.sort(order, axis=0) == np.arange(2)[:, None]).all()
    assert np.isnan(sure[:, :42]).all()


def test_balls_that_meet_while_no_camera_sees_them_are_marked_as_doubtful():
    X, R = motions(1)
    apart = np.where(TIME_S < 0.1, 20 * (0.1 - TIME_S), 20 * (TIME_S - 0.1))[:, None] * np.array([1.0, 0, 0])
    X = np.concatenate([X - apart, X + apart])
    R = np.concatenate([R, R])  # nor do their rotations differ
    seen = np.ones((2, FRAMES), bool)
    seen[:, 40:80] = False
    _, sure = same_balls(X, R, seen, TIME_S, [])
    assert np.isnan(sure[:, :40]).all()
    assert (sure[:, 80:] < 0.99).all()
    assert (sure[:, 80:] > 0.4).all()

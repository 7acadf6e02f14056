"""Rotations: (..., 3, 3) matrices that act on columns, not checked; rotation vectors (..., 3), rad, right-handed."""

import ctypes
import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor
from torch.autograd import forward_ad

from sphereorient.errors import SettingsError, ShapeError, check_tail, refusal
from sphereorient.files.compiled import compiled, record

SOURCE = Path(__file__).with_suffix("")
_Rotations = record(SOURCE, "Rotations")
NO_ROTATION = 1e-3  # tolerance of an entry of R R^T - I, far above rounding: half a milliradian
ROUNDING = 1e-9  # keeps a whole number from being rounded up by the last bits of a sine
HALF_EDGE = 2 ** (1 / 3) / 2  # half the edge of the body-centred cubic lattice with one point per unit volume


def exp(rotvec: Tensor) -> Tensor:
    """Return the rotations (..., 3, 3) of rotation vectors (..., 3), rad, of any length, by Rodrigues' formula."""
    check_tail("rotvec", rotvec, 3)
    if (done := _compiled("so3_exp", rotvec, 1, (3, 3))) is not None:
        return done
    turn = torch.linalg.vector_norm(rotvec, dim=-1)[..., None, None]
    # sin(t) / t and (1 - cos(t)) / t^2; the unused branch needs a finite argument for its gradient.
    some = turn > torch.finfo(turn.dtype).tiny ** 0.25
    t = torch.where(some, turn, torch.ones_like(turn))
    along = torch.where(some, t.sin() / t, torch.ones_like(t))
    across = torch.where(some, 2 * ((t / 2).sin() / t).square(), torch.full_like(t, 0.5))
    K = hat(rotvec)
    return torch.eye(3, dtype=K.dtype, device=K.device) + along * K + across * (K @ K)


def log(R: Tensor) -> Tensor:
    """Return the shortest rotation vectors (..., 3), rad, of rotations (..., 3, 3), not checked.
    At exactly pi the choice between the two vectors is always the same, and the gradient is finite.
    Source: Shepperd 1978, through the quaternion's largest component, so it keeps all digits at 0 and at pi.
    """
    check_tail("R", R, 3, 3)
    if (done := _compiled("so3_log", R, 2, (3,))) is not None:
        return done
    xx, xy, xz, yx, yy, yz, zx, zy, zz = R.flatten(-2).unbind(-1)
    x, y, z, xy, xz, yz = zy - yz, xz - zx, yx - xy, xy + yx, xz + zx, yz + zy
    squares = 1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz
    # Four times the products of the quaternion's components (w, x, y, z), row by row.
    products = torch.stack(
        [squares[0], x, y, z, x, squares[1], xy, xz, y, xy, squares[2], yz, z, xz, yz, squares[3]], dim=-1
    ).reshape(*R.shape[:-2], 4, 4)
    largest = torch.stack(squares, dim=-1).argmax(-1)[..., None, None]
    quat_wxyz = products.gather(-2, largest.expand(*R.shape[:-2], 1, 4))[..., 0, :]
    w, axis = quat_wxyz[..., :1], quat_wxyz[..., 1:]
    axis = torch.where(w < 0, -axis, axis)
    length = torch.linalg.vector_norm(axis, dim=-1, keepdim=True)
    turned = ~(length <= torch.finfo(R.dtype).tiny ** 0.5)  # NaN stays NaN
    length = torch.where(turned, length, torch.ones_like(length))
    return axis * torch.where(turned, 2 * torch.atan2(length, w.abs()) / length, 0.5)


def _compiled(name: str, given: Tensor, dims: int, tail: tuple[int, ...]) -> Tensor | None:
    """Return the result of compiled code for items of `dims` dimensions: items of shape `tail`. None if it was not
    built, the numbers are no doubles on the CPU, or derivatives are needed.
    """
    code = compiled(SOURCE, _Rotations)
    plain = type(given) is Tensor and given.dtype == torch.float64 and given.device.type == "cpu"
    if code is None or not plain or given.requires_grad or forward_ad.unpack_dual(given).tangent is not None:  # type: ignore[no-untyped-call]
        return None
    given = given.contiguous()
    try:
        begin = given.data_ptr()
    except RuntimeError:  # a tensor of torch.func has no storage
        return None
    made = given.new_empty(*given.shape[: given.ndim - dims], *tail)
    getattr(code, name)(ctypes.byref(_Rotations(made.numel() // math.prod(tail), begin, made.data_ptr())))
    return made


def check_rotations(name: str, R: Tensor) -> None:
    """Refuse matrices (..., 3, 3) that are no rotations (ShapeError); NaN, for unknown ones, are allowed."""
    check_tail(name, R, 3, 3)
    if not R.is_floating_point():
        do = "convert it with .double() or .float()"
        raise ShapeError(refusal(name, expected="a floating-point tensor", got=str(R.dtype), do=do))
    M = R.detach()
    off = (M @ M.mT - torch.eye(3, dtype=M.dtype, device=M.device)).abs().flatten(-2).amax(-1)
    wrong = (off > NO_ROTATION) | (torch.linalg.det(M) < 0)
    if wrong.any():
        det = float(torch.linalg.det(M[wrong][0]))
        got = f"{int(wrong.sum())} of {wrong.numel()} that are not, the first with det {det:.3g}"
        do = "make them with so3.exp of rotation vectors, or mend rounding with so3.nearest_rotation"
        raise ShapeError(refusal(name, expected="rotations, R R^T = I and det 1", got=got, do=do))


def hat(v: Tensor) -> Tensor:
    """Return the antisymmetric matrix (..., 3, 3) whose product with a vector x is the cross product v × x."""
    check_tail("v", v, 3)
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*v.shape[:-1], 3, 3)


def vee(M: Tensor) -> Tensor:
    """Return the vector (..., 3) of a matrix' antisymmetric part; for a rotation: axis times sine of the angle."""
    check_tail("M", M, 3, 3)
    twice = M - M.mT
    return torch.stack([twice[..., 2, 1], twice[..., 0, 2], twice[..., 1, 0]], -1) / 2


def angle(R: Tensor) -> Tensor:
    """Return the angle (...), rad, 0 .. pi, of rotations (..., 3, 3), accurate also near 0 and pi.
    The gradient at exactly 0 and pi, which does not exist, is set to 0.
    Source: docs/errata.md A3; acos((Tr - 1)/2), the paper's, loses half the digits near 0 and pi.
    """
    check_tail("R", R, 3, 3)
    cosine = (R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    # vector_norm has gradient 0 at 0, that is at angles 0 and pi; atan2 is smooth at both.
    return torch.atan2(torch.linalg.vector_norm(vee(R), dim=-1), cosine)


def geodesic_distance(A: Tensor, B: Tensor) -> Tensor:
    """Return the angle (...), rad, 0 .. pi, of A^T B for rotations (..., 3, 3); exactly 0 for equal inputs.
    Gradient as `angle`.
    Source: the paper's d(A, B), worked out by docs/errata.md A3; the cosine from Tr((A-B)(A-B)^T) = 4 (1 - cos d).
    """
    check_tail("A", A, 3, 3)
    check_tail("B", B, 3, 3)
    D = B - A
    # A^T A is symmetric, so A^T B and A^T (B - A) have the same vee: with rows a, d it is half the sum of d × a.
    # Unlike the product A^T B, the difference keeps its digits if A and B are close.
    sine = torch.linalg.vector_norm(torch.linalg.cross(D, A.expand_as(D)).sum(-2), dim=-1) / 2
    return torch.atan2(sine, 1 - D.square().sum((-2, -1)) / 4)


def nearest_rotation(M: Tensor) -> Tensor:
    """Return the rotation nearest to any matrix M (..., 3, 3), by the sum of squared differences; NaN if not finite.
    If several are equally near (rank below 2, or a reflection with equal smallest singular values) it is one of them,
    with gradient 0 in the undetermined directions. First derivatives only.
    Source: Kabsch 1976, the paper's R_kabsch; derivative of the polar factor, textbook.
    """
    check_tail("M", M, 3, 3)
    finite = M.isfinite().all(-1).all(-1)[..., None, None]
    M = torch.where(finite, M, torch.eye(3, dtype=M.dtype, device=M.device))
    U, S, Vh = torch.linalg.svd(M.detach())
    sign = torch.linalg.det(U @ Vh).sign()[..., None]
    signs = torch.cat([torch.ones_like(S[..., :2]), sign], -1)
    S, Vh = S * signs, signs[..., None] * Vh
    R = U @ Vh
    # U and V have no derivative where singular values are equal, as they are for every rotation; their product has,
    # with only sums of singular values in the denominator: dR = U X V^T, X = antisymmetric part of U^T dM V / sums.
    sums = S[..., :, None] + S[..., None, :]
    decided = sums > 8 * torch.finfo(M.dtype).eps * S[..., :1, None]
    turned = U.mT @ M @ Vh.mT
    X = torch.where(decided, (turned - turned.mT) / torch.where(decided, sums, torch.ones_like(sums)), 0)
    step = U @ X @ Vh
    return torch.where(finite, R + (step - step.detach()), torch.full_like(R, torch.nan))


def weighted_mean(R: Tensor, weights: Tensor) -> Tensor:
    """Return the rotation (..., 3, 3) with the smallest weighted sum of squared angles to R (..., K, 3, 3).
    Weights (..., K) are not negative, of any sum; NaN rotations of weight 0 are ignored; NaN if all weights are 0.
    If several means are equally good, the choice is always the same.
    Source: Karcher mean; Hartley et al. 2013, Rotation averaging, algorithm 1.
    """
    check_tail("R", R, *weights.shape[-1:], 3, 3)
    weights = weights.to(R)
    share = (weights / weights.sum(-1, keepdim=True))[..., None]
    missing = (share == 0)[..., None] & R.isnan()
    R = torch.where(missing, torch.eye(3, dtype=R.dtype, device=R.device), R)
    mean = nearest_rotation((share[..., None] * R).sum(-3))
    for _ in range(12):
        mean = mean @ exp((share * log(mean[..., None, :, :].mT @ R)).sum(-2))
    return mean


def random_rotations(
    shape: int | Sequence[int],
    *,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str | None = None,
) -> Tensor:
    """Return rotations (*shape, 3, 3) drawn uniformly from SO(3), from the same numbers in every dtype.
    Source: a quaternion of four normal numbers has a uniform direction (Marsaglia 1972).
    """
    leading = (shape,) if isinstance(shape, int) else tuple(shape)
    origin = generator.device if generator is not None else None
    quat_wxyz = torch.randn(*leading, 4, generator=generator, dtype=torch.float64, device=origin)
    w, x, y, z = torch.nn.functional.normalize(quat_wxyz, dim=-1).unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, -1).reshape(*leading, 3, 3).to(dtype=dtype, device=device)


def from_tait_bryan(theta: Tensor) -> Tensor:
    """Return the rotation (..., 3, 3) of angles theta (..., 3), rad: Rx Ry Rz, the paper's R_lab_body.
    Source: the paper's R(theta): rotations about the fixed z, then y, then x; or about the body's x, then its new y,
    then its new z (docs/errata.md E9).
    """
    check_tail("theta", theta, 3)
    (sx, sy, sz), (cx, cy, cz) = theta.sin().unbind(-1), theta.cos().unbind(-1)
    rows = [
        *(cy * cz, -cy * sz, sy),
        *(cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy),
        *(sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy),
    ]
    return torch.stack(rows, -1).reshape(*theta.shape[:-1], 3, 3)


def to_tait_bryan(R: Tensor) -> Tensor:
    """Return the Tait-Bryan angles (..., 3), rad, of rotations (..., 3, 3), with theta_y in -pi/2 .. pi/2; NaN for NaN.
    At cos(theta_y) = 0 (below four roundings) only theta_x ± theta_z is defined: theta_z and its gradient are 0.
    Source: docs/errata.md E1, with other elements for theta_y and theta_x, equal for a rotation: asin loses half the
    digits near theta_y = ± pi/2, and -R23, R33 lose all.
    """
    check_tail("R", R, 3, 3)
    cos_y = torch.linalg.vector_norm(R[..., 0, :2], dim=-1)
    defined = ~(cos_y <= 4 * torch.finfo(R.dtype).eps)  # for NaN all three angles are NaN
    zero, one = torch.zeros_like(cos_y), torch.ones_like(cos_y)
    theta_z = torch.atan2(torch.where(defined, -R[..., 0, 1], zero), torch.where(defined, R[..., 0, 0], one))
    # R Rz^T = Rx Ry has the second column (0, cos theta_x, sin theta_x), independent of theta_y.
    column = R[..., 1:, 0] * theta_z.sin()[..., None] + R[..., 1:, 1] * theta_z.cos()[..., None]
    theta_x = torch.atan2(column[..., 1], column[..., 0])
    return torch.stack([theta_x, torch.atan2(R[..., 0, 2], cos_y), theta_z], -1)


def second_triplet(theta: Tensor) -> Tensor:
    """Return the other angles (..., 3), rad, not wrapped, of the rotation by theta (..., 3), rad:
    theta_x + pi, ± pi - theta_y with the sign of theta_y, theta_z + pi.
    Source: the paper's second triplet with sign(0) = 1, docs/errata.md E2.
    """
    check_tail("theta", theta, 3)
    x, y, z = theta.unbind(-1)
    half_turn = torch.where(y < 0, torch.full_like(y, -math.pi), torch.full_like(y, math.pi))
    return torch.stack([x + math.pi, half_turn - y, z + math.pi], -1)


def rate_matrix_lab(theta: Tensor) -> Tensor:
    """Return H (..., 3, 3) with H dtheta/dt = omega_lab, for the angles of R_lab_body; its determinant is cos(theta_y).
    Source: the paper's H, which it assigns to the body (docs/errata.md E3).
    """
    check_tail("theta", theta, 3)
    x, y, _ = theta.unbind(-1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    sx, cx, sy, cy = x.sin(), x.cos(), y.sin(), y.cos()
    return torch.stack([one, zero, sy, zero, cx, -sx * cy, zero, sx, cx * cy], -1).reshape(*theta.shape[:-1], 3, 3)


def rate_matrix_body(theta: Tensor) -> Tensor:
    """Return R^T `rate_matrix_lab` (..., 3, 3), from dtheta/dt to omega_body (docs/errata.md E3)."""
    return from_tait_bryan(theta).mT @ rate_matrix_lab(theta)


def to_lattman(theta: Tensor) -> Tensor:
    """Return the Lattman angles (theta_x + theta_z, theta_y, theta_x - theta_z) of Tait-Bryan angles (..., 3), rad."""
    check_tail("theta", theta, 3)
    x, y, z = theta.unbind(-1)
    return torch.stack([x + z, y, x - z], -1)


def from_lattman(lattman: Tensor) -> Tensor:
    """Return the Tait-Bryan angles (..., 3), rad, of Lattman angles with ranges 4 pi, -pi/2 .. pi/2, 2 pi."""
    check_tail("lattman", lattman, 3)
    plus, y, minus = lattman.unbind(-1)
    return torch.stack([(plus + minus) / 2, y, (plus - minus) / 2], -1)


def lattman_steps(theta_y: Tensor, delta: float) -> tuple[Tensor, Tensor]:
    """Return the steps of theta_plus and theta_minus, (...) rad each, that rotate by `delta` rad.
    theta_y (...), rad, is in -pi/2 .. pi/2; at the ends one angle has no effect and an infinite step.
    Source: d^2 = dtheta^2 + sin^2(pi/4 + theta/2) dtheta_plus^2 + sin^2(pi/4 - theta/2) dtheta_minus^2, the paper's own
    metric; the steps that it prints do not follow from it (docs/errata.md E5).
    """
    quarter = math.pi / 4
    return delta / (quarter + theta_y / 2).sin(), delta / (quarter - theta_y / 2).sin()


def lattman_grid(
    step_rad: float, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
) -> Tensor:
    """Return a grid of rotations (K, 3, 3), evenly over SO(3); K is about 8 pi^2 / step_rad^3, step_rad at most pi.
    Every rotation is within (1/2 + 1/sqrt 2) step_rad of the grid; random ones within sqrt(3)/2 step_rad (measured in
    tests/so3/test_so3_lattman.py). Rows of theta_y from -pi/2, each by theta_plus, then theta_minus. The last row,
    theta_y = pi/2, holds its rotations twice: there 2 pi of theta_plus is a full turn.
    Source: Lattman 1972 as in the paper, with the steps of docs/errata.md E5. SettingsError: no step in 0 .. pi.
    """
    if not 0 < step_rad <= math.pi:
        raise SettingsError(refusal("step_rad", expected="0 .. pi", got=f"{step_rad}", do="give the step in rad"))
    rows = max(math.ceil(math.pi / step_rad - ROUNDING), 1) + 1
    theta_y = torch.linspace(-math.pi / 2, math.pi / 2, rows, dtype=torch.float64)
    counts = [
        (length / step - ROUNDING).ceil().clamp_min(1).int().tolist()
        for length, step in zip((4 * math.pi, 2 * math.pi), lattman_steps(theta_y, step_rad), strict=True)
    ]
    angles = [
        torch.cartesian_prod(_circle(4 * math.pi, plus), y[None], _circle(2 * math.pi, minus))
        for y, plus, minus in zip(theta_y, *counts, strict=True)
    ]
    return from_tait_bryan(from_lattman(torch.cat(angles))).to(dtype=dtype, device=device)


def _circle(length: float, count: int) -> Tensor:
    return torch.arange(count, dtype=torch.float64) * (length / count)


def local_grid(
    step_rad: float, radius_rad: float, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
) -> Tensor:
    """Return rotations (M, 3, 3) spread evenly up to the angle radius_rad (0 .. pi), the unit first, then by angle.
    The rotation vectors are a body-centred cubic lattice with one point per step_rad^3, in rad; each rotation's inverse
    is included. Covering radius c = 0.704 step_rad: every rotation by at most radius_rad - c is within c of the grid,
    every one by at most radius_rad within 2 c.
    Source: Conway and Sloane, Sphere Packings, Lattices and Groups, ch. 2 (covering radius sqrt(5)/4 of the edge).
    Raises SettingsError: the step is not above 0, or the radius not in 0 .. pi.
    """
    if not step_rad > 0:
        raise SettingsError(refusal("step_rad", expected="above 0", got=f"{step_rad}", do="give the step in rad"))
    if not 0 <= radius_rad <= math.pi:
        do = "give the radius in rad, or take lattman_grid for all rotations"
        raise SettingsError(refusal("radius_rad", expected="0 .. pi", got=f"{radius_rad}", do=do))
    unit = HALF_EDGE * step_rad
    reach = radius_rad / unit * (1 + 1e-9)  # keeps a shell exactly on the rim
    line = torch.arange(-math.floor(reach), math.floor(reach) + 1)
    places = torch.cartesian_prod(line, line, line)
    norm2 = places.square().sum(1)
    inside = (norm2 <= math.floor(reach**2)) & (places % 2 == places[:, :1] % 2).all(1)
    # in whole numbers ties in angle are exact, and the stable sort keeps their order
    order = norm2[inside].argsort(stable=True)
    return exp(places[inside][order].to(torch.float64) * unit).to(dtype=dtype, device=device)


def trace(matrix: Tensor) -> Tensor:
    """Return the traces (...) of matrices (..., n, n)."""
    return matrix.diagonal(dim1=-2, dim2=-1).sum(-1)


def solve_damped(matrix: Tensor, right: Tensor, ridge: float = 1e-9) -> Tensor:
    """Solve symmetric positive semidefinite systems (..., n, n), (..., n); `ridge` is a share of each diagonal element.
    A direction without information gets no step.
    """
    solution: Tensor = torch.linalg.solve_ex(_damped(matrix, ridge), right[..., None]).result
    return solution[..., 0]


def inverse_damped(matrix: Tensor) -> Tensor:
    """Invert symmetric positive semidefinite matrices (..., n, n), damped as in `solve_damped`."""
    inverse: Tensor = torch.linalg.inv_ex(_damped(matrix, 1e-9)).inverse
    return inverse


def cross_first_axis(a: Tensor, b: Tensor) -> Tensor:
    """Return a x b of (L, 3, ...), along axis 1; `torch.linalg.cross` is several times slower along a middle axis."""
    (ax, ay, az), (bx, by, bz) = a.unbind(1), b.unbind(1)
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], dim=1)


def _damped(matrix: Tensor, ridge: float) -> Tensor:
    size = matrix.diagonal(dim1=-2, dim2=-1).clamp_min(0)
    return matrix + torch.diag_embed(ridge * size + 1e-12)

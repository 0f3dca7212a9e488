"""The computations behind docs/errata.md: each returns plain numbers."""

import math

import torch

from torchrod import (
    GaussianCoordinates,
    Markers,
    PaperCoordinates,
    PointForces,
    Robot,
    Rod,
    Settings,
    Tendon,
    Tendons,
    cold_start,
    estimate,
    load_bound,
    paper_settings,
    solve_shape,
)
from torchrod.estimation import filter as ekf
from torchrod.estimation.solve import linearize
from torchrod.mechanics.lie import rotate

from .cases import L, S, Study, steel_rod, study1
from .paper_mode import paper_problem

OFFSET = 0.007  # m, of the tendon of the one-tendon robot (tests/data/shape_reference.json)
PULLED = {"cm": 0.115, "mm": 0.0115}  # m of tendon: the largest actuation of the tables, read as cm and as mm
CASE = 11  # of Study 1: the paper's own recursion converges on it
TOLD = 1e-3  # m: the noise that markers without noise state
CHOICES = {  # which Sigma_bar stands in front of H^T in the gain, and inside it: 0 this step's, -1 the step before's
    "i in front, i inside (right)": (0, 0),
    "i - 1 in front, i inside (printed)": (-1, 0),
    "i - 1 in front, i - 1 inside": (-1, -1),
}


def linear_innovation(iterations: int = 6) -> dict[str, list[float]]:
    """|x - truth| by iteration of (4) on z = H x, 8 data and 3 unknowns, with either sign of the innovation."""
    generator = torch.Generator().manual_seed(0)
    H, truth = torch.randn(1, 8, 3, generator=generator, dtype=torch.float64), torch.tensor([[1.0, -2.0, 0.5]]).double()
    z, w, zero = (H @ truth.unsqueeze(-1)).squeeze(-1), torch.ones(1, 8).double(), torch.zeros(3).double()
    errors: dict[str, list[float]] = {}
    for name, sign in (("z - h", 1.0), ("h - z", -1.0)):
        x, Sigma = torch.zeros_like(truth), torch.eye(3).double().unsqueeze(0)
        errors[name] = []
        for _ in range(iterations):
            errors[name].append(float((x - truth).norm()))
            A, g = ekf.information(H, sign * (z - (H @ x.unsqueeze(-1)).squeeze(-1)), w, x, zero, zero)
            step, Sigma, _ = ekf.update(ekf.predict(Sigma, zero + 1.0), A, g)
            x = x + step
    return errors


def shape_innovation(study: Study, paper: bool, iterations: int) -> dict[str, list[float | None]]:
    """Root mean square distance of the markers (mm) by iteration on one case of Study 1; None once there is no shape.

    paper: gamma = [a, eta, c] and the plain recursion; otherwise our coordinates with steps of at most 0.6.
    """
    markers = study.noisy(0.0, 1, TOLD).take(torch.tensor([CASE]))
    problem = paper_problem(study.robot, markers) if paper else study.problem(markers)
    settings = paper_settings(problem) if paper else Settings()
    one = torch.ones(problem.size, dtype=torch.float64)
    residuals: dict[str, list[float | None]] = {}
    for name, sign in (("z - h", 1.0), ("h - z", -1.0)):
        x, Sigma = cold_start(problem).x, torch.diag(settings.Sigma0 * one).unsqueeze(0)
        residuals[name] = []
        for _ in range(iterations):
            at = linearize(problem, x)
            size = 1e3 * float((at.r[:, :-6].square().sum() / len(S)).sqrt())
            residuals[name].append(size if math.isfinite(size) else None)
            A, g = ekf.information(at.H, sign * at.r, problem.weights, x, problem.mean, problem.precision)
            step, Sigma, _ = ekf.update(ekf.predict(Sigma, settings.Q * one), A, g)
            x = x + step * (settings.step_limit / step.abs().max()).clamp(max=1.0)
    return residuals


def index_choices() -> dict[str, float]:
    """|x - batch least squares| after 8 data, one at a time, 3 unknowns at rest (Q = 0), for choices of Sigma_bar in the gain of
    (4).

    The covariance update takes Sigma_bar_i, as printed and as is right; the prior stands in for the one before the first.
    """
    generator = torch.Generator().manual_seed(1)
    H, z = torch.randn(8, 3, generator=generator, dtype=torch.float64), torch.randn(8, generator=generator, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64)
    batch = torch.linalg.solve(eye + H.T @ H, H.T @ z)  # prior x = 0 +- 1, unit noise
    off = {}
    for name, (front, inside) in CHOICES.items():
        x, Sigma, predicted = torch.zeros(3, dtype=torch.float64), eye, [eye]
        for h, value in zip(H, z, strict=True):
            predicted.append(Sigma)
            K = predicted[-1 + front] @ h / (h @ predicted[-1 + inside] @ h + 1)
            x, Sigma = x + K * (value - h @ x), predicted[-1] - torch.outer(K, h @ predicted[-1])
        off[name] = float((x - batch).norm())
    return off


def damping(study: Study, powers: tuple[float, ...], count: int) -> dict[str, dict[str, float]]:
    """Per Q, over `count` cases: the mean first step from one start with Sigma_0 = 0, and the mean iterations (at most 200)."""
    problem = study.problem(study.noisy(0.0, 1, TOLD).take(torch.arange(count)))
    at = linearize(problem, cold_start(problem).x, exact=False)
    rows = {}
    for Q in powers:
        step, *_ = ekf.update(ekf.predict(torch.zeros_like(at.A), Q * torch.ones(problem.size, dtype=torch.float64)), at.A, at.g)
        fit = estimate(problem, Settings(1.0, Q, max_iterations=200, restarts=()))
        rows[f"{Q:g}"] = {
            "step": float(step.norm(dim=-1).mean()),
            "iterations": float(fit.iterations.double().mean()),
            "converged": float((fit.status == 0).double().mean()),
        }
    return rows


def undamped(study: Study, powers: tuple[float, ...]) -> dict[str, dict[str, float]]:
    """Per Q, in our coordinates without step limit and adaptive noise: share converged and their mean iterations (at most 500)."""
    problem, rows = study.problem(study.noisy(0.0, 1, TOLD)), {}
    for Q in powers:
        settings = Settings(1.0, Q, step_limit=math.inf, adaptive=False, coarse=False, max_iterations=500, restarts=())
        fit = estimate(problem, settings)
        done = fit.status == 0
        rows[f"{Q:g}"] = {"iterations": float(fit.iterations[done].double().mean()), "converged": float(done.double().mean())}
    return rows


def contraction(a: float = 1.0, iterations: int = 20) -> dict[str, float]:
    """Error left after `iterations` of (4) on one unknown with information a, Sigma_0 = 1, per Q."""
    left = {}
    for Q in (0.0, 0.01, 1.0, 100.0):
        Sigma, error = 1.0, 1.0
        for _ in range(iterations):
            bar = Sigma + Q
            Sigma = bar / (1 + a * bar)
            error *= 1 - a * Sigma
        left[f"{Q:g}"] = error
    return left


def actuation() -> dict[str, dict[str, float]]:
    """The one-tendon robot without gravity, pulled as far as the tables say if they were in cm, and in mm.

    Geometry: pulling x of a tendon at the offset r bends by x / r. Statics: the tension acts on the lever r, so the moment is
    tau r everywhere and the bend tau r L / EI. Both are measured on the shape of the forward solve.
    """
    robot = Robot(Rod.circular(L, 0.0014, 207e9, 79e9), Tendons((Tendon.straight(OFFSET, 0.0, L),)))
    EI = robot.rod.bending_stiffness
    s = torch.linspace(0.0, L, 401, dtype=torch.float64)
    bend = torch.tensor([x / OFFSET for x in PULLED.values()], dtype=torch.float64)
    tension = bend * EI / (OFFSET * L)
    shape = solve_shape(robot, (), tension.unsqueeze(-1), s, len(bend), 160)
    tendon = shape.p + rotate(shape.q, torch.tensor([OFFSET, 0.0, 0.0], dtype=torch.float64))
    centre, pulled = (p.diff(dim=1).norm(dim=-1).sum(-1) for p in (shape.p, tendon))
    d = shape.p.diff(dim=1)
    turns = torch.atan2(d[..., 0], d[..., 2]).diff(dim=1)
    measured = torch.remainder(turns + math.pi, 2 * math.pi).sub(math.pi).sum(1) * 400 / 399  # 400 chords make 399 angles
    stress = 207e9 * 0.0007 * bend / L  # of the outer fibre
    keys = ("bend_rad", "bend_solved_rad", "tension_N", "pulled_m", "pulled_solved_m", "stress_Pa", "solved")
    columns = (bend, measured.abs(), tension, bend * OFFSET, centre - pulled, stress, shape.status == 0)
    return {unit: {k: float(c[i]) for k, c in zip(keys, columns, strict=True)} for i, unit in enumerate(PULLED)}


def counts() -> dict[str, int]:
    """Parameters of three Gaussians by (12), and of the sum of (10) from k = 0 to 3."""
    return {"three_gaussians": PaperCoordinates(3, L).size, "gaussians_k_0_to_3": PaperCoordinates(4, L).size}


def points() -> dict[str, float]:
    """Discs 5 cm apart on 40 cm, base disc included; standard deviation of a push's location (m) from all of them and from those
    off the base, for a case of Study 1's rod, 1 mm noise.
    """
    study = study1(1, 5)
    s = torch.arange(9, dtype=torch.float64) * 0.05
    load = PointForces(torch.nn.functional.pad(study.force, (0, 1)).unsqueeze(1), study.location.unsqueeze(1))
    found = {"discs": float(len(s)), "length_m": float(s[-1]), "location_m": float(study.location[0])}
    for name, places in (("nine", s), ("eight", s[1:])):
        shape = solve_shape(study.robot, (load,), None, places, 1)
        bound = load_bound(study.robot, Markers(places, shape.p, 1e-3), study.force, study.location, study.base_wrench)
        found[f"location_std_{name}_m"] = float(bound[0])
    return found


def over_the_tip(sigma: float = 0.01) -> dict[str, dict[str, float]]:
    """(13) over the force on the rod, for a Gaussian of 0.1 N net on the rod centred 3, 2, 1 and 0 sigma before the tip.

    base: the force that the forward solve finds at the clamp.
    """
    robot = steel_rod()
    coordinates = GaussianCoordinates(1, L, robot.rod.force_scale)
    rows = {}
    for before in (3.0, 2.0, 1.0, 1e-6):
        t = torch.tensor(1 - before * sigma / L, dtype=torch.float64)
        gamma = torch.stack([0 * t + 0.1 / robot.rod.force_scale, 0 * t, torch.logit(t), 0 * t + math.log(0.5 * (L / sigma) ** 2)])
        report = coordinates.describe(gamma.unsqueeze(0))
        shape = solve_shape(robot, coordinates.loads(gamma.unsqueeze(0)), None, S, 1)
        rows[f"{before:.0f}"] = {
            "force_N": float(report.force.norm()),
            "net_force_N": float(report.net_force.norm()),
            "base_N": float(shape.base_wrench[0, :3].norm()),
        }
    return rows

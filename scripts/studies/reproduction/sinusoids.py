"""Figure 2 and (5): RMS deflection of the rod under f(s) = A sin(n pi s / L), simply supported and cantilevered.

Euler-Bernoulli, EI w'''' = A sin(k s), k = n pi / L:

    (a)  simply supported, w = w'' = 0 at both ends:  w = A sin(k s) / (EI k^4)
    (b)  RMS over the rod, mean of sin^2 = 1/2:       A L^4 / (sqrt(2) EI n^4 pi^4): (5) with EI where it belongs
    (c)  a section that shears (GA) adds A sin(k s) / (GA k^2): (b) times 1 + EI k^2 / GA
    (d)  clamped at 0, free at L.  From w'''(L) = 0:  EI w''' = -A cos(k s) / k + C,  C = (-1)^n A / k
         w''(L) = 0 (sin(k L) = 0):                   EI w''  = -A sin(k s) / k^2 + C (s - L)
         w'(0) = w(0) = 0:                            EI w    = A (sin(k s) - k s) / k^4 + C (s^3 / 6 - L s^2 / 2)
    (e)  C belongs to the clamp: its moment, int s f ds = -C L, falls like 1/n only, and so does w, whose first term falls like
         1/n^3. For large n the RMS is A L^4 sqrt(11/420) / (n pi EI), because int_0^1 (x^3/6 - x^2/2)^2 dx = 11/420.
"""

import math
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchrod import FourierLoads, Robot, Rod, Shape, shape_from_base, solve_shape

from .cases import L, steel_rod

WAVES = range(1, 11)
A = 1e-3  # N/m: slopes stay below 1e-3 rad, the linear range; deflections are quoted per 1 N/m
STEPS = 160  # 16 to each half wave of n = 10
S = torch.linspace(0.0, L, 401, dtype=torch.float64)
GREY, NAVY, RED = "#9a9a9a", "#1b2a41", "#c8102e"


def rigid_section(robot: Robot) -> Robot:
    """The same rod with a section that neither shears nor stretches, as Euler-Bernoulli has it."""
    return Robot(Rod.from_stiffness(robot.rod.length, 1e12 * torch.eye(3, dtype=torch.float64), robot.rod.K_bt))


def sine_load(n: Tensor) -> FourierLoads:
    """A sin(n pi s / L) along x for each n (B,): the n-th sine of a Fourier series of length 2 L."""
    most = int(n.max())
    sine = torch.zeros(len(n), 2, most, dtype=torch.float64)
    sine[range(len(n)), 0, n - 1] = A
    return FourierLoads(torch.zeros(len(n), 2, most + 1, dtype=torch.float64), sine, 2 * L)


def rms(w: Tensor) -> Tensor:
    """Root of the mean over the rod of w(S)^2, w (..., S)."""
    return (torch.trapezoid(w * w, S, dim=-1) / L).sqrt()


def supported(robot: Robot, n: Tensor) -> Tensor:
    """RMS deflection (m per N/m) of the Cosserat rod on two supports, (B,).

    March from the base under alpha = [n_x, 0, 0, 0, 0, 0]; the support's force n_x is the one whose tip moment vanishes (secant;
    the tip's own force is the other support's). The march leaves the base along z; a small rigid turn puts the tip on the axis.
    """
    loads = (sine_load(n),)

    def marched(force: Tensor) -> Shape:
        return shape_from_base(robot, loads, torch.nn.functional.pad(force, (0, 5)), None, S, STEPS, differentiable=False)

    def tip_moment(force: Tensor) -> Tensor:
        return marched(force).tip_residual[:, 4:5]

    before, force = torch.zeros(len(n), 1, dtype=torch.float64), torch.full((len(n), 1), A * L, dtype=torch.float64)
    for _ in range(2):
        slope = (tip_moment(force) - tip_moment(before)) / (force - before)
        before, force = force, force - tip_moment(force) / slope
    w = marched(force).p[..., 0]
    return rms(w - w[:, -1:] * S / L) / A


def clamped(robot: Robot, n: Tensor) -> Tensor:
    """RMS deflection (m per N/m) of the Cosserat rod as a cantilever, (B,)."""
    return rms(solve_shape(robot, (sine_load(n),), None, S, len(n), STEPS).p[..., 0]) / A


def supported_closed(EI: float, n: Tensor) -> Tensor:
    """(b), m per N/m."""
    return L**4 / (math.sqrt(2) * EI * (n.double() * math.pi) ** 4)


def clamped_closed(EI: float, n: Tensor) -> Tensor:
    """RMS of (d), m per N/m."""
    k = (n.double() * math.pi / L).unsqueeze(-1)
    sign = 1 - 2 * (n % 2).unsqueeze(-1)
    return rms((torch.sin(k * S) - k * S) / k**4 + sign / k * (S**3 / 6 - L * S**2 / 2)) / EI


def slope_of(n: Tensor, y: Tensor) -> float:
    """Slope of log y against log n, least squares."""
    x, y = n.double().log(), y.log()
    x = x - x.mean()
    return float((x * y).sum() / (x * x).sum())


def deflections() -> dict[str, Tensor]:
    """Every curve, m per N/m, over WAVES."""
    n, robot = torch.tensor(list(WAVES)), steel_rod()
    EI, thin = robot.rod.bending_stiffness, rigid_section(robot)
    k = n.double() * math.pi / L
    return {
        "supported_formula": supported_closed(EI, n),
        "supported_cosserat": supported(thin, n),
        "supported_shearing": supported(robot, n),
        "supported_shearing_formula": supported_closed(EI, n) * (1 + EI * k**2 / robot.rod.K_se[0, 0]),
        "clamped_formula": clamped_closed(EI, n),
        "clamped_cosserat": clamped(thin, n),
        "clamped_shearing": clamped(robot, n),
        "clamped_asymptote": L**4 * math.sqrt(11 / 420) / (n.double() * math.pi * EI),
        "printed": supported_closed(1.0, n),
    }


def off(a: Tensor, b: Tensor) -> float:
    """Largest relative difference."""
    return float((a / b - 1).abs().max())


def run(quick: bool, folder: Path) -> tuple[dict[str, float], list[str]]:
    """Closed forms and Cosserat solutions for n = 1..10, slopes, agreement, and the picture."""
    w, n = deflections(), torch.tensor(list(WAVES))
    EI = steel_rod().rod.bending_stiffness
    data = {
        "EI_Nm2": EI,
        "amplitude_N_per_m": A,
        "supported_slope": slope_of(n, w["supported_cosserat"]),
        "clamped_slope": slope_of(n[1:], w["clamped_cosserat"][1:]),
        "clamped_slope_from_n_1": slope_of(n, w["clamped_cosserat"]),
        "supported_off": off(w["supported_cosserat"], w["supported_formula"]),
        "clamped_off": off(w["clamped_cosserat"], w["clamped_formula"]),
        "shear_at_n_10": float(w["supported_shearing"][-1] / w["supported_formula"][-1] - 1),
        "shear_off": off(w["supported_shearing"], w["supported_shearing_formula"]),
        "clamped_shear_off": off(w["clamped_shearing"], w["clamped_formula"]),
        "printed_n_1_Nm3_per_N_per_m": float(w["printed"][0]),
        "solver_n_1_m_per_N_per_m": float(w["supported_cosserat"][0]),
        "printed_over_solver": float((w["printed"] / w["supported_cosserat"])[0]),
    }
    data |= {f"{key}_n_{m}_m": float(w[key][m - 1]) for key in ("supported_cosserat", "clamped_cosserat") for m in WAVES}
    _figure(n, w, data, folder / "figure2.png")
    return data, _lines(n, w, data)


def _lines(n: Tensor, w: dict[str, Tensor], d: dict[str, float]) -> list[str]:
    rows = [
        f"| {int(m)} | {1e3 * w['supported_formula'][i]:.6g} | {1e3 * w['supported_cosserat'][i]:.6g} "
        f"| {1e3 * w['clamped_formula'][i]:.6g} | {1e3 * w['clamped_cosserat'][i]:.6g} |"
        for i, m in enumerate(n.tolist())
    ]
    return [
        "## Figure 2 and (5): sinusoidal loads",
        "",
        "f(s) = A sin(n pi s / L) on the rod of the studies; RMS deflection over the rod, per N/m. We read (5) as that RMS on",
        f"simple supports, printed A L^4 / (sqrt(2) n^4 pi^4), without EI = {d['EI_Nm2']:.5f} N m^2; here EI is in the",
        "denominator. Beside the closed forms of Euler-Bernoulli, the Cosserat solver with a section that neither shears nor",
        f"stretches, A = {1e3 * A:g} mN/m:",
        "",
        "| n | supported: (5) with EI (mm) | Cosserat | cantilever: closed form (mm) | Cosserat |",
        "|---|---|---|---|---|",
        *rows,
        "",
        f"Largest relative difference: supported {d['supported_off']:.1e}, cantilever {d['clamped_off']:.1e}. The real section",
        f"shears: at n = 10 it bends {100 * d['shear_at_n_10']:.2f} % further, a factor 1 + EI (n pi / L)^2 / GA (to",
        f"{d['shear_off']:.0e}). Slopes in log-log: supported {d['supported_slope']:.3f}; cantilever {d['clamped_slope']:.2f} over",
        f"n = 2..10 ({d['clamped_slope_from_n_1']:.2f} from n = 1, where the two terms of the closed form are still of one size).",
        "A cantilever filters far less: its clamp carries the load's moment, which falls like 1/n",
        "(scripts/studies/reproduction/sinusoids.py derives it), so (5) does not hold for a robot clamped at its base.",
        "",
        "![RMS deflection against the number of half waves: 1/n^4 on simple supports, 1/n as a cantilever](figure2.png)",
        "",
    ]


def _figure(n: Tensor, w: dict[str, Tensor], d: dict[str, float], path: Path) -> None:
    """Both supports, closed form and solver."""
    figure = Figure(figsize=(7.2, 4.8), layout="constrained")
    axes = figure.add_subplot()
    axes.loglog(n, 1e3 * w["clamped_formula"], color=RED, label="cantilever: Euler-Bernoulli closed form")
    axes.loglog(
        n, 1e3 * w["clamped_cosserat"], "o", mfc="none", color=RED, label=f"cantilever: Cosserat, slope {d['clamped_slope']:.2f}"
    )
    axes.loglog(n, 1e3 * w["clamped_asymptote"], ":", color=GREY, label="its asymptote, exactly 1/n")
    axes.loglog(n, 1e3 * w["supported_formula"], color=NAVY, label="simply supported: (5) with EI in the denominator")
    label = f"simply supported: Cosserat, slope {d['supported_slope']:.2f}"
    axes.loglog(n, 1e3 * w["supported_cosserat"], "s", mfc="none", color=NAVY, label=label)
    axes.set_xticks(n.tolist(), [str(m) for m in n.tolist()])
    axes.minorticks_off()
    axes.set_xlabel("n, half waves of the load A sin(n π s / L) on the rod")
    axes.set_ylabel("RMS deflection (mm per N/m)")
    axes.set_title("Steel rod, L = 400 mm, d = 1.4 mm: what a sinusoidal load does to the shape", fontsize=10)
    axes.set_ylim(1e-4, 60)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="lower left")
    figure.savefig(path, dpi=150)

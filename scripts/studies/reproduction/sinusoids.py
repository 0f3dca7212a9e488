"""Figure 2 and (5): what a load f(s) = A sin(omega s), omega = n pi / L, does to the shape of a rod.

The paper's Figure 2 is a beam with L = 1 m, EI = 1 N m^2 and A = 16 pi^4 N/m under n = 2, 4 and 20 half waves. Beyond it, here: the
RMS deflection of the rod of the studies, simply supported and cantilevered. Euler-Bernoulli, EI w'''' = A sin(k s), k = n pi / L:

    (a)  simply supported, w = w'' = 0 at both ends:  w = A sin(k s) / (EI k^4)
    (b)  RMS over the rod, mean of sin^2 = 1/2:       sqrt(2) A / (2 EI k^4): (5) with EI in the denominator
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
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from torchrod import FourierLoads, Robot, Rod, Shape, shape_from_base, solve_shape

from .cases import L, steel_rod

WAVES = range(1, 11)
A = 1e-3  # N/m: slopes stay below 1e-3 rad, the linear range; deflections are quoted per 1 N/m
STEPS = 320  # 16 to each half wave of n = 20
SHARE = torch.linspace(0.0, 1.0, 401, dtype=torch.float64)  # s / L
PRINTED_WAVES = (2, 4, 20)  # of the paper's Figure 2
PRINTED_A = 16 * math.pi**4  # N/m
GREY, NAVY, RED = "#9a9a9a", "#1b2a41", "#c8102e"


def printed_beam() -> Robot:
    """The beam of the paper's Figures 2 to 4: L = 1 m, EI = 1 N m^2; ours is a round steel rod (3.15 mm)."""
    return Robot(Rod.circular(1.0, (64 / (207e9 * math.pi)) ** 0.25, 207e9, 79e9))


def rigid_section(robot: Robot) -> Robot:
    """The same rod with a section that neither shears nor stretches, as Euler-Bernoulli has it."""
    return Robot(Rod.from_stiffness(robot.rod.length, 1e12 * torch.eye(3, dtype=torch.float64), robot.rod.K_bt))


def sine_load(n: Tensor, length: float) -> FourierLoads:
    """A sin(n pi s / L) along x for each n (B,): the n-th sine of a Fourier series of length 2 L."""
    most = int(n.max())
    sine = torch.zeros(len(n), 2, most, dtype=torch.float64)
    sine[range(len(n)), 0, n - 1] = A
    return FourierLoads(torch.zeros(len(n), 2, most + 1, dtype=torch.float64), sine, 2 * length)


def rms(w: Tensor) -> Tensor:
    """Root of the mean over the rod of w^2, w (..., S) at SHARE."""
    return torch.trapezoid(w * w, SHARE, dim=-1).sqrt()


def supported(robot: Robot, n: Tensor) -> Tensor:
    """RMS deflection (m per N/m) of the Cosserat rod on two supports, (B,).

    March from the base under alpha = [n_x, 0, 0, 0, 0, 0]; the support's force n_x is the one whose tip moment vanishes (secant;
    the tip's own force is the other support's). The march leaves the base along z; a small rigid turn puts the tip on the axis.
    """
    length = robot.rod.length
    loads, s = (sine_load(n, length),), length * SHARE

    def marched(force: Tensor) -> Shape:
        return shape_from_base(robot, loads, torch.nn.functional.pad(force, (0, 5)), None, s, STEPS, differentiable=False)

    def tip_moment(force: Tensor) -> Tensor:
        return marched(force).tip_residual[:, 4:5]

    before, force = torch.zeros(len(n), 1, dtype=torch.float64), torch.full((len(n), 1), A * length, dtype=torch.float64)
    for _ in range(2):
        slope = (tip_moment(force) - tip_moment(before)) / (force - before)
        before, force = force, force - tip_moment(force) / slope
    w = marched(force).p[..., 0]
    return rms(w - w[:, -1:] * SHARE) / A


def clamped(robot: Robot, n: Tensor) -> Tensor:
    """RMS deflection (m per N/m) of the Cosserat rod as a cantilever, (B,)."""
    length = robot.rod.length
    return rms(solve_shape(robot, (sine_load(n, length),), None, length * SHARE, len(n), STEPS).p[..., 0]) / A


def supported_closed(EI: float, n: Tensor, length: float = L) -> Tensor:
    """(b), m per N/m. With 1 / EI in the place of EI it is (5) as printed."""
    return math.sqrt(2) / (2 * EI * (n.double() * math.pi / length) ** 4)


def clamped_closed(EI: float, n: Tensor) -> Tensor:
    """RMS of (d), m per N/m."""
    k, s = (n.double() * math.pi / L).unsqueeze(-1), L * SHARE
    sign = 1 - 2 * (n % 2).unsqueeze(-1)
    return rms((torch.sin(k * s) - k * s) / k**4 + sign / k * (s**3 / 6 - L * s**2 / 2)) / EI


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
        "printed": supported_closed(1 / EI, n),
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
        "printed_n_1": float(w["printed"][0]),
        "solver_n_1_m_per_N_per_m": float(w["supported_cosserat"][0]),
        "printed_over_solver": float((w["printed"] / w["supported_cosserat"])[0]),
    }
    data |= {f"{key}_n_{m}_m": float(w[key][m - 1]) for key in ("supported_cosserat", "clamped_cosserat") for m in WAVES}
    m, beam = torch.tensor(PRINTED_WAVES), rigid_section(printed_beam())
    closed = supported_closed(1.0, m, 1.0)
    data |= {f"figure2_rms_m_N_{k}": PRINTED_A * float(v) for k, v in zip(PRINTED_WAVES, closed, strict=True)}
    data |= {"figure2_off": off(supported(beam, m), closed)}
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
        "![Top: three loads of one size and the beam under each. Bottom: RMS deflection against the number of half waves]"
        "(figure2.png)",
        "",
        "Top: the paper's figure on its numbers, L = 1 m, EI = 1 N m^2, f(s) = A sin(N pi s / L) with A = 16 pi^4 N/m, by",
        "Euler-Bernoulli on simple supports. RMS deflection: "
        + "; ".join(f"N = {k}: {d[f'figure2_rms_m_N_{k}']:.3g} m" for k in PRINTED_WAVES)
        + ". The load of",
        "N = 20 is as strong as that of N = 2 and leaves no trace. The Cosserat solver agrees within the linear range, to",
        f"{d['figure2_off']:.0e} (the slopes of the beam drawn for N = 2 are far beyond it). With EI = 1 N m^2 the printed (5) and",
        "the right one give the same number.",
        "",
        "Bottom, beyond the paper: the rod of the studies, RMS deflection over the rod, per N/m. (5) is printed",
        f"sqrt(2) A EI / (2 omega^4), with EI = {d['EI_Nm2']:.5f} N m^2 in the numerator; here it is in the denominator. Beside",
        "the",
        "closed forms of Euler-Bernoulli, the Cosserat solver with a section that neither shears nor",
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
    ]


def _figure(n: Tensor, w: dict[str, Tensor], d: dict[str, float], path: Path) -> None:
    """Top: the paper's three panels. Bottom: both supports of the rod of the studies, closed form and solver."""
    figure = Figure(figsize=(11, 8.6), layout="constrained")
    halves = figure.add_gridspec(2, 1, height_ratios=(1, 1.35))
    top, bottom = figure.add_subfigure(halves[0]), figure.add_subfigure(halves[1])
    top.suptitle("Paper's Figure 2: simply supported beam, L = 1 m, EI = 1 N m², load A sin(N π s / L), A = 16 π⁴ N/m", fontsize=11)
    panels = top.subplots(1, len(PRINTED_WAVES), sharey=True)
    for axes, m in zip(panels, PRINTED_WAVES, strict=True):
        _panel(axes, m, d[f"figure2_rms_m_N_{m}"])
    panels[0].set_ylabel("deflection (m)", color=NAVY)
    _over_waves(bottom.subplots(), n, w, d)
    figure.savefig(path, dpi=130)


def _panel(axes: Axes, m: int, rms_m: float) -> None:
    """One load and the beam under it, on the scales that all panels share."""
    load = 1e-3 * PRINTED_A * torch.sin(m * math.pi * SHARE)
    right = axes.twinx()
    right.fill_between(SHARE, load, color=RED, alpha=0.15, lw=0)
    right.plot(SHARE, load, color=RED, lw=1, label="load f(s)")
    right.set_ylim(-2.6, 2.6)
    right.set_yticks([-1.5, 0, 1.5])
    right.tick_params(colors=RED)
    if m == PRINTED_WAVES[-1]:
        right.set_ylabel("load (kN/m)", color=RED)
    else:
        right.set_yticklabels([])
    axes.axhline(0, color=GREY, lw=1, ls="--")
    axes.plot(SHARE, 1e3 * load / (m * math.pi) ** 4, color=NAVY, lw=2.5, label="deformed beam")
    axes.set_zorder(right.get_zorder() + 1)
    axes.patch.set_visible(False)
    axes.set_ylim(-1.25, 1.25)
    axes.set_xlabel("s (m)")
    axes.set_title(f"N = {m}: deflects by {rms_m:.2g} m RMS", fontsize=10)
    handles = [*axes.get_legend_handles_labels()[0], *right.get_legend_handles_labels()[0]]
    axes.legend(handles=handles, fontsize=8, loc="lower left", ncols=2)


def _over_waves(axes: Axes, n: Tensor, w: dict[str, Tensor], d: dict[str, float]) -> None:
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
    axes.set_title("Beyond the paper: rod of the studies, L = 400 mm, 1.4 mm steel", fontsize=11)
    axes.set_ylim(1e-4, 60)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="lower left")

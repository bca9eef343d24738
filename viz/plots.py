"""The plots of the static report, drawn with matplotlib: one log over time, and in distributions.

They show what the timeline shows, in the same colours, in a few kilobytes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl

from stages.results import PROBABILITY, Diagnosis
from viz import lanes
from viz.colours import (
    BLUE,
    DETECTED,
    DIM,
    EXCEEDANCE,
    GREY,
    INJECTED,
    SKY_BLUE,
    VERMILLION,
    Colour,
    hex_of,
    of_fault,
    of_index,
)
from viz.evidence import leading, table
from viz.residuals import WIDTH, column, names, view_range
from viz.series import Array, break_at_gaps, envelope, spans
from viz.statistics import abscissa, cdf, in_alarm, telling
from viz.svg import FAINT, INK
from viz.views import KEY_SIGNALS

POINTS = 480
"""Points of a line: about one a pixel."""
RESIDUALS, DISTRIBUTIONS, HYPOTHESES = 3, 3, 4
INCHES = 9.6
SCATTERED = 1500
LANES = (("injected", lanes.INJECTED), ("diagnosed", lanes.DIAGNOSED), ("regime", lanes.REGIME))


def timeline_plot(diagnosis: Diagnosis) -> Any:
    """A key signal, the most telling residuals with their bands, probabilities, and the lanes; of a log
    without an alarm one residual and no probabilities."""
    from matplotlib.figure import Figure

    samples = diagnosis.samples
    alarm = bool(in_alarm(samples).any())
    shown = telling(samples)[: RESIDUALS if alarm else 1]
    signal = next((n for n in KEY_SIGNALS if _is_there(diagnosis, n)), None)
    heights = [0.7] * bool(signal) + [1.0] * len(shown) + [0.8] * alarm + [0.62]
    figure = Figure(figsize=(INCHES, 1.15 * sum(heights) + 0.5))
    axes = figure.subplots(len(heights), sharex=True, height_ratios=heights, squeeze=False)[:, 0].tolist()
    inch = 1.0 / figure.get_figheight()
    figure.subplots_adjust(left=0.075, right=0.99, top=1 - 0.25 * inch, bottom=0.45 * inch, hspace=0.42)
    rest = iter(axes)
    if signal:
        _signal(next(rest), diagnosis, signal)
    for name in shown:
        _residual(next(rest), diagnosis, name)
    if alarm:
        _probabilities(next(rest), samples)
    _lanes(next(rest), diagnosis)
    axes[-1].set_xlabel("time [s]")
    return figure


def _is_there(diagnosis: Diagnosis, name: str) -> bool:
    log = diagnosis.log
    return name in log.signals and log.group_of(name).frame.height > 0


def _signal(ax: Any, diagnosis: Diagnosis, name: str) -> None:
    group, signal = diagnosis.log.group_of(name), diagnosis.log.signals[name]
    order = np.argsort(group.time, kind="stable")
    time, values = break_at_gaps(group.time[order], diagnosis.log.values(name)[order][:, None])
    ax.plot(*envelope(time, values, POINTS), color=hex_of(SKY_BLUE))
    ax.set_title(f"{name} [{signal.unit or '?'}]")


def _residual(ax: Any, diagnosis: Diagnosis, name: str) -> None:
    samples = diagnosis.samples
    source = dict(names(samples))[name]
    time, value = column(samples, "time"), column(samples, source)
    sigma, z = column(samples, f"sigma.{name}"), column(samples, f"z.{name}")
    centre = value - z * sigma
    limits = view_range(value, centre, sigma)
    _shade(ax, diagnosis)
    at, rows = break_at_gaps(time, np.stack([centre - WIDTH * sigma, centre + WIDTH * sigma, value], axis=1))
    band, lines = envelope(at, np.clip(rows[:, :2], *limits), POINTS // 2)
    ax.fill_between(band, lines[:, 0], lines[:, 1], color=hex_of(GREY), alpha=0.35, linewidth=0, step="post")
    ax.plot(*envelope(at, rows[:, 2:], POINTS), color=hex_of(SKY_BLUE))
    over = np.where(np.abs(z) > WIDTH, value, np.nan)
    if np.isfinite(over).any():  # as a line: markers would be an element each
        ax.plot(*envelope(time, over[:, None], POINTS), color=hex_of(EXCEEDANCE), linewidth=1.6)
    ax.set_ylim(*limits)
    ax.set_title(
        f"residual {name} [{diagnosis.units.get(name) or '1'}] · band: ±{WIDTH:g} sigma · red: beyond"
    )


def _shade(ax: Any, diagnosis: Diagnosis) -> None:
    time = column(diagnosis.samples, "time")
    for start, end in spans(time, in_alarm(diagnosis.samples)):
        ax.axvspan(start, end, color=hex_of(DETECTED), alpha=0.12, linewidth=0)
    for event in lanes.truth(diagnosis.log):
        ax.axvline(event.t_start, color=hex_of(INJECTED), linewidth=1.2, linestyle=(0, (4, 3)))


def _probabilities(ax: Any, samples: pl.DataFrame) -> None:
    known = [f for f in leading(samples) if PROBABILITY + f in samples.columns]
    shown = [f for f in known if float(column(samples, PROBABILITY + f).max(initial=0.0)) > 0.02][:HYPOTHESES]
    if shown:
        time, values = table(samples, [PROBABILITY + f for f in shown])
        at, lines = envelope(time, values, POINTS)
        for i, fault in enumerate(shown):
            ax.plot(at, lines[:, i], color=hex_of(of_fault(fault)), label=fault, drawstyle="steps-post")
        ax.legend(loc="center left", ncols=1, borderaxespad=0.2)
    ax.set_ylim(-0.03, 1.05)
    ax.set_title("probability of each hypothesis")


def _lanes(ax: Any, diagnosis: Diagnosis) -> None:
    samples = diagnosis.samples
    time = column(samples, "time")
    found: dict[str, list[tuple[float, float, Colour]]] = {"injected": _injected(diagnosis)}
    found["diagnosed"] = _states(time, lanes.diagnosed(samples), of_fault)
    if "regime" in samples.columns:
        regimes = samples["regime"].fill_null(-1).to_numpy()
        found["regime"] = _states(time, regimes, lambda r: of_index(int(r)) if r >= 0 else DIM)
    shown = [(name, bars) for name, bars in found.items() if bars]
    for row, (_, bars) in enumerate(shown):
        spanned = [(start, max(end - start, 0.0)) for start, end, _ in bars]
        colours = [hex_of(colour) for *_, colour in bars]
        ax.broken_barh(spanned, (-row - 0.4, 0.8), facecolors=colours, linewidth=0, rasterized=len(bars) > 60)
    ax.set_yticks([-i for i in range(len(shown))], [name for name, _ in shown])
    ax.set_ylim(-len(shown) + 0.45, 0.55)
    ax.grid(False)


def _injected(diagnosis: Diagnosis) -> list[tuple[float, float, Colour]]:
    events, known = lanes.truth(diagnosis.log), column(diagnosis.samples, "time")
    if not lanes.truth_known(diagnosis.log) or not known.size:
        return []
    time, kinds = lanes.held(events, float(known[0]), float(known[-1]))
    return [
        (float(a), float(b), of_fault(kind or "none"))
        for a, b, kind in zip(time[:-1], time[1:], kinds[:-1], strict=True)
    ]


def _states(time: Array, states: Any, colour: Any) -> list[tuple[float, float, Colour]]:
    edges = np.flatnonzero(np.append(True, states[1:] != states[:-1])) if len(states) else np.empty(0, int)
    ends = np.append(time[edges[1:]], time[-1:])
    return [(float(time[a]), float(b), colour(states[a])) for a, b in zip(edges.tolist(), ends, strict=True)]


def distribution_plot(diagnosis: Diagnosis) -> Any:
    """Distributions of the residuals (dissertation, figure 5.12), and the strongest one against the pressure
    ratio by regime (figure 5.13)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(INCHES, 2.5))
    axes = figure.subplots(1, 2)
    figure.subplots_adjust(left=0.075, right=0.985, top=0.9, bottom=0.2, wspace=0.16)
    _distributions(axes[0], diagnosis.samples)
    _against(axes[1], diagnosis)
    return figure


def _distributions(ax: Any, samples: pl.DataFrame) -> None:
    alarm = in_alarm(samples)
    for i, name in enumerate(telling(samples)[:DISTRIBUTIONS]):
        z = column(samples, f"z.{name}")
        for rows, line in ((~alarm, ":"), (alarm, "-")):
            if rows.any():
                x, share = cdf(z[rows])
                ax.plot(x, share, line, color=hex_of(of_index(i)), label=name if line == "-" else None)
    ax.axvspan(-WIDTH, WIDTH, color=hex_of(GREY), alpha=0.2, linewidth=0)
    ax.set_xlim(-12, 12)
    ax.set_ylim(0, 1.02)
    ax.set_xlabel("z [sigma]")
    ax.set_ylabel("share below")
    ax.set_title("distribution of z" + (" · dotted: no alarm" if alarm.any() else ""))
    if alarm.any() and ax.get_legend_handles_labels()[1]:
        ax.legend(loc="upper left", borderaxespad=0.2, handlelength=1.2)


def _against(ax: Any, diagnosis: Diagnosis) -> None:
    samples, shown = diagnosis.samples, telling(diagnosis.samples)
    beside = abscissa(diagnosis)
    if beside is None or not shown:
        ax.set_visible(False)
        return
    label, x = beside
    source = dict(names(samples))[shown[0]]
    y, alarm = column(samples, source), in_alarm(samples)
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    rows = known[:: max(1, -(-known.size // SCATTERED))]
    regime = samples["regime"].fill_null(-1).to_numpy() if "regime" in samples.columns else np.zeros(x.size)
    colours = np.array([hex_of(of_index(int(r)) if r >= 0 else GREY) for r in regime[rows]])
    for mask, marker, size in ((~alarm[rows], ".", 5.0), (alarm[rows], "x", 9.0)):
        ax.scatter(
            x[rows][mask], y[rows][mask], s=size, c=colours[mask], marker=marker, linewidths=0.7,
            rasterized=True,
        )  # fmt: skip
    sigma = column(samples, f"sigma.{shown[0]}")
    ax.set_ylim(*view_range(y, y - column(samples, f"z.{shown[0]}") * sigma, sigma))
    ax.set_xlabel(label)
    ax.set_title(f"{shown[0]} by regime" + (" · x: in alarm" if alarm.any() else ""))


def matrix(ax: Any, values: Array, rows: list[str], heads: list[str], *, limit: float) -> None:
    """Numbers on a field from blue (below) to vermillion (above), ``limit`` as deep as it gets."""
    from matplotlib.colors import LinearSegmentedColormap

    shades = LinearSegmentedColormap.from_list("", [hex_of(BLUE), "#ffffff00", hex_of(VERMILLION)])
    ax.imshow(
        np.nan_to_num(values), cmap=shades, vmin=-limit, vmax=limit, aspect="auto", interpolation="nearest"
    )
    ax.set_xticks(range(len(heads)), heads, rotation=0 if max(map(len, heads), default=0) < 6 else 30)
    ax.set_yticks(range(len(rows)), rows)
    ax.tick_params(length=0)
    ax.grid(False)
    if values.size <= 200:
        for (i, j), value in np.ndenumerate(values):
            if np.isfinite(value):
                text = f"{value:.0f}" if abs(value) >= 9.95 else f"{value:.1f}"
                ax.text(j, i, text, ha="center", va="center", fontsize=7.0, color=INK)
    for spine in ax.spines.values():
        spine.set_color(FAINT)


def matrices_plot(
    signatures: dict[str, dict[str, float]], separations: dict[str, dict[str, float]]
) -> Any | None:
    """Faults against residuals (mean z in alarm) and faults against hypotheses (lead in evidence); None where
    no fault was found. ``signatures`` and ``separations``: by fault, then by residual or hypothesis."""
    from matplotlib.figure import Figure

    faults = [f for f in signatures if signatures[f]]
    if not faults:
        return None
    figure = Figure(figsize=(INCHES, 1.35 + 0.27 * len(faults)))
    axes = figure.subplots(1, 2)
    figure.subplots_adjust(
        left=0.17, right=0.985, top=1 - 0.3 / figure.get_figheight(), bottom=0.85 / figure.get_figheight(),
        wspace=0.06,
    )  # fmt: skip
    for ax, found, limit in ((axes[0], signatures, 6.0), (axes[1], separations, 100.0)):
        heads = list(dict.fromkeys(h for fault in faults for h in found.get(fault, {})))
        heads.sort(key=lambda h: faults.index(h) if h in faults else len(faults))
        values = [[found.get(f, {}).get(h, np.nan) for h in heads] for f in faults]
        matrix(ax, np.array(values).reshape(len(faults), len(heads)), faults, heads, limit=limit)
    axes[0].set_title("signatures: mean z of each residual in alarm")
    axes[1].set_title("isolability: lead in evidence [nats: e-fold odds]")
    axes[1].set_yticklabels([])
    for ax in axes:
        for label in ax.get_xticklabels():
            label.set_ha("right" if label.get_rotation() else "center")
    return figure

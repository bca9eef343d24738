"""How residuals are spread: in and out of alarm, against the pressure ratio, and regime by regime."""

from __future__ import annotations

import numpy as np
import rerun as rr

from stages.results import PROBABILITY, Diagnosis
from viz import send
from viz.colours import GREY, WHITE, Colour, of_index
from viz.lanes import regime_name
from viz.plane import CELL, FRAMED, HEIGHT, ROW, WIDTH, Axes, frame, matrix, text
from viz.residuals import WIDTH as BAND
from viz.residuals import column, names, view_range
from viz.series import Array
from viz.statistics import abscissa, cdf, in_alarm, leads, regime_signature, signature, telling
from viz.summary import table

CDF, AGAINST, BY_REGIME, LEADS = "/cdf", "/against", "/signature", "/leads"
SHOWN = 4
REACH = 12.0
"""z where the distributions' picture ends."""
SAMPLES = 4000
NAMES = 24.0
"""Room for the names of the lines, beside the picture."""


def log_distributions(rec: rr.RecordingStream, diagnosis: Diagnosis) -> dict[str, str]:
    """All pictures that the diagnosis gives something for; their titles by path."""
    samples = diagnosis.samples
    ranked = telling(samples)
    if not ranked:
        return {}
    alarm = in_alarm(samples)
    titles = {
        CDF: "Share of samples below z" + (" · dim: no alarm · bright: in alarm" if alarm.any() else "")
    }
    _log_cdf(rec, diagnosis, ranked[:SHOWN])
    if (beside := abscissa(diagnosis)) is not None:
        _log_against(rec, diagnosis, ranked[0], *beside)
        titles[AGAINST] = f"{ranked[0]} by regime" + (" · white rim: in alarm" if alarm.any() else "")
    when = "in alarm" if alarm.any() else "over the whole log"
    regimes, shown, means = regime_signature(samples)
    if not regimes:
        shown, means = list(signature(samples)), np.array([*signature(samples).values()])[:, None]
    heads = [regime_name(r) for r in regimes] or ["all"]
    matrix(rec, BY_REGIME, means, shown, heads, limit=6.0)
    titles[BY_REGIME] = f"Signature: mean z {'by regime, ' if regimes else ''}{when}"
    if words := _leads(diagnosis):
        send.markdown(rec, LEADS, words)
        titles[LEADS] = "Isolability: how far behind the other hypotheses are"
    return titles


def bounds(path: str, diagnosis: Diagnosis) -> tuple[tuple[float, float], tuple[float, float]]:
    """What a picture needs to be seen whole: x and y limits of its plane."""
    if path == CDF:
        return (FRAMED[0][0], WIDTH + NAMES), FRAMED[1]
    if path != BY_REGIME:
        return FRAMED
    regimes, shown, _ = regime_signature(diagnosis.samples)
    return (-2.2 * CELL, (max(len(regimes), 1) + 0.3) * CELL), (-2.0 * ROW, (len(shown) + 0.3) * ROW)


def _log_cdf(rec: rr.RecordingStream, diagnosis: Diagnosis, shown: list[str]) -> None:
    """One line a residual and state of alarm, and the band of +-3 sigma."""
    samples, alarm = diagnosis.samples, in_alarm(diagnosis.samples)
    axes = Axes(x=(-REACH, REACH), y=(0.0, 1.0))
    frame(rec, CDF, axes, "z [sigma]", "share of samples")
    strips, colours, widths = [], [], []
    for i, name in enumerate(shown):
        z = column(samples, f"z.{name}")
        for rows, bright in ((~alarm, not alarm.any()), (alarm, True)):
            if np.isfinite(z[rows]).any():
                strips.append(axes.place(_within(*cdf(z[rows]))))
                colours.append(of_index(i) if bright else _dim(of_index(i)))
                widths.append(1.8 if bright else 1.0)
    rec.log(
        f"{CDF}/lines",
        rr.LineStrips2D(strips, colors=colours, radii=rr.Radius.ui_points(widths)),
        static=True,
    )
    edges = [axes.place(np.array([[x, 0.0], [x, 1.0]])) for x in (-BAND, BAND)]
    rec.log(f"{CDF}/band", rr.LineStrips2D(edges, colors=GREY, radii=rr.Radius.ui_points(1.0)), static=True)
    for i, name in enumerate(shown):
        text(rec, f"{CDF}/names/{i}", [[WIDTH + NAMES / 2, -HEIGHT + 3.0 + 6.0 * i]], [name], of_index(i))


def _within(x: Array, share: Array) -> Array:
    """The part of a distribution that the picture has room for, shape (n, 2)."""
    left, right = np.interp([-REACH, REACH], x, share, left=0.0, right=1.0)
    inside = np.abs(x) < REACH
    first, last = [[-REACH, left]] if left > 0 else [], [[REACH, right]]
    return np.array([*first, *np.stack([x[inside], share[inside]], axis=1), *last])


def _dim(colour: Colour) -> Colour:
    red, green, blue = (int(part * 0.5) for part in colour)
    return red, green, blue


def _log_against(rec: rr.RecordingStream, diagnosis: Diagnosis, name: str, label: str, x: Array) -> None:
    samples = diagnosis.samples
    y, sigma = column(samples, dict(names(samples))[name]), column(samples, f"sigma.{name}")
    low, high = view_range(y, y - column(samples, f"z.{name}") * sigma, sigma)
    points = np.stack([x, np.clip(y, low, high)], axis=1)
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    if not known.size:
        return
    rows = known[:: max(1, -(-known.size // SAMPLES))]
    across = Axes.around(points[rows])
    axes = Axes(x=across.x, y=(low, high) if high > low else across.y)
    frame(rec, AGAINST, axes, label, f"{name} [{diagnosis.units.get(name) or '1'}]")
    regime = (
        samples["regime"].fill_null(-1).to_numpy()[rows]
        if "regime" in samples.columns
        else np.zeros(rows.size)
    )
    colours = np.array([of_index(int(r)) if r >= 0 else GREY for r in regime], dtype=np.uint8)
    placed, alarm = axes.place(points[rows]), in_alarm(samples)[rows]
    if alarm.any():
        rim = rr.Points2D(placed[alarm], colors=WHITE, radii=rr.Radius.ui_points(2.6), draw_order=30.0)
        rec.log(f"{AGAINST}/rim", rim, static=True)
    dots = rr.Points2D(placed, colors=colours, radii=rr.Radius.ui_points(1.8), draw_order=31.0)
    rec.log(f"{AGAINST}/samples", dots, static=True)


def _leads(diagnosis: Diagnosis) -> str:
    """The verdict's lead over each other hypothesis as a table; nothing without one."""
    fault = diagnosis.verdict.fault
    ahead = leads(diagnosis.samples, fault)
    if not ahead:
        return ""
    probability = diagnosis.verdict.probability
    rows = [
        (other, f"{lead:.1f}", _odds(lead), f"{probability[other]:.1%}" if other in probability else "–")
        for other, lead in sorted(ahead.items(), key=lambda item: item[1])
        if PROBABILITY + other in diagnosis.samples.columns or other == "none"
    ]
    head = ("hypothesis", "evidence behind [nats]", "told apart", "probability")
    return f"Against **{fault}**, where its own evidence is greatest:\n\n" + table(head, rows)


def _odds(lead: float) -> str:
    """
    >>> _odds(0.4), _odds(2.0), _odds(80.0)
    ('no', 'hardly', 'yes')
    """
    return "yes" if lead > 4.6 else "hardly" if lead > 1.1 else "no"

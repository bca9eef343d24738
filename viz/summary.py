"""A diagnosis in words: what, since when, how sure, why, on what data, by which detector (Markdown)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import PurePath
from typing import Any

import numpy as np
import polars as pl

from ingest.log import Event, Log
from stages.results import Diagnosis, Magnitude, Verdict
from viz.lanes import regime_name, truth, truth_known
from viz.remarks import flagged, quality_events, short, shortcomings
from viz.residuals import column, names, telling_rows
from viz.statistics import leads

REASONS = 3
REGIME_ROWS = 40
WORDS = {
    "none": "No fault found",
    "insufficient_evidence": "Too little usable data for a verdict",
    "unknown": "A fault that no hypothesis explains",
    "maf_gain": "Air mass flow sensor reads wrong",
    "boost_pressure_gain": "Boost pressure sensor reads wrong",
    "intake_pressure_gain": "Intake pressure sensor reads wrong",
    "intake_temperature_gain": "Intake temperature sensor reads wrong",
    "boost_leak": "Leak in the boost manifold",
    "intake_leak": "Leak in the intake manifold",
    "egr_stuck_open": "EGR valve stuck open",
    "egr_stuck_closed": "EGR valve stuck closed",
    "sensor_stuck": "Sensor stuck",
    "sensor_noise": "Sensor noisy",
    "sensor_offset": "Sensor off by an offset",
    "tps_time_constant": "Throttle position sensor's speed has changed",
    "tps_gain": "Throttle position sensor's gain has changed",
    "motor_torque_constant": "Throttle motor's torque constant has changed",
    "back_emf_constant": "Throttle motor's back e.m.f. constant has changed",
}
"""Faults as people call them; others bear their own names."""


def summary(diagnosis: Diagnosis, remarks: Iterable[str] = ()) -> str:
    """The whole summary of a run; ``remarks`` on how its log is drawn go to the data."""
    verdict, log = diagnosis.verdict, diagnosis.log
    parts = [
        f"## {headline(verdict)}",
        _facts_of_verdict(verdict, truth(log), truth_known(log)),
        "### Why\n" + _bullets(reasons(diagnosis)),
        "### Data\n" + _bullets([*_data(diagnosis), *remarks]),
        "### Provenance\n" + _provenance(verdict, log),
    ]
    return "\n\n".join(part for part in parts if part)


def headline(verdict: Verdict) -> str:
    """The verdict as a title.

    >>> headline(Verdict(log="a", recipe="r", detector=None, fault="boost_leak"))
    'Leak in the boost manifold (boost_leak)'
    >>> headline(Verdict(log="a", recipe="r", detector=None, fault="none"))
    'No fault found'
    """
    parts = verdict.fault.split("+")
    words = " and ".join(WORDS.get(part, part) for part in parts)
    if verdict.fault in ("none", "insufficient_evidence", "unknown"):
        return words
    signal = f", {verdict.signal}" if verdict.signal else ""
    name = f"{verdict.fault}{signal}" if all(part in WORDS for part in parts) else verdict.signal
    return f"{words} ({name})" if name else words


def magnitude_text(magnitude: Magnitude) -> str:
    """A magnitude as people write it.

    >>> magnitude_text(Magnitude(value=-0.1, sd=0.004, unit="1"))
    '-10.0 ± 0.4 %'
    >>> magnitude_text(Magnitude(value=0.0209, sd=0.0004, unit="1"))
    '2.09 ± 0.04 %'
    >>> magnitude_text(Magnitude(value=4.02, sd=None, unit="mm"))
    '4.02 mm'
    """
    scale, unit = (100.0, "%") if magnitude.unit == "1" else (1.0, magnitude.unit)
    value = magnitude.value * scale
    if magnitude.sd is None:
        return f"{value:.3g} {unit}"
    first = -int(np.floor(np.log10(magnitude.sd * scale))) if magnitude.sd > 0 else 0
    digits = min(max(0, first + 1), max(1, first) if unit == "%" else 2, 2)
    return f"{value:.{digits}f} ± {magnitude.sd * scale:.{digits}f} {unit}"


def _facts_of_verdict(verdict: Verdict, injected: list[Event], known: bool) -> str:
    delay = detection_delay(verdict, injected)
    rows = [
        ("Onset", None if verdict.onset_s is None else f"{verdict.onset_s:.1f} s"),
        ("Detected", None if verdict.detected_s is None else f"{verdict.detected_s:.1f} s"),
        ("Magnitude", magnitude_text(verdict.magnitude) if verdict.magnitude else None),
        *((f"Magnitude of {part}", magnitude_text(size)) for part, size in pair_sizes(verdict).items()),
        ("Probability", probabilities(verdict)),
        *(("Injected", injected_text(event)) for event in injected),
        ("Injected", "nothing: known to be fault-free" if known and not injected else None),
        ("Against the truth", agreement(verdict, injected) if known else None),
        ("Delay", None if delay is None else f"{delay:.1f} s"),
    ]
    said = [(name, text) for name, text in rows if text]
    return table(("", verdict.log), said) if said else ""


def pair_sizes(verdict: Verdict) -> dict[str, Magnitude]:
    """The size of each of two faults at once; empty for a single fault, whose size is the verdict's."""
    sizes = verdict.statistics.get("magnitudes", {})
    return {part: Magnitude(**size) for part, size in sizes.items()} if len(sizes) > 1 else {}


def injected_text(event: Event) -> str:
    """An injected fault with its size and time."""
    size = ""
    if event.magnitude is not None:
        size = " " + magnitude_text(Magnitude(value=event.magnitude, sd=None, unit=event.unit or "1"))
    end = "" if event.t_end is None else f" to {event.t_end:.1f} s"
    return f"{event.kind}{size} from {event.t_start:.1f} s{end}"


def agreement(verdict: Verdict, injected: Iterable[Event]) -> str:
    """Whether the verdict names what was injected; without any event, that nothing was."""
    faults = {part for event in injected for part in event.kind.split("+")}
    named = set(verdict.fault.split("+"))
    if named == (faults or {"none"}):
        return "correct"
    if not faults:
        return "too little data" if verdict.fault == "insufficient_evidence" else "false alarm"
    if verdict.fault in ("none", "insufficient_evidence"):
        return "missed"
    if verdict.fault == "unknown":
        return "noticed, not named"
    return "one of the injected faults" if named <= faults else "wrong"


def detection_delay(verdict: Verdict, injected: Iterable[Event]) -> float | None:
    """Detection minus the start of the injection it answers to, s: the last one begun before it."""
    if verdict.detected_s is None:
        return None
    begun = [event.t_start for event in injected if event.t_start <= verdict.detected_s]
    return verdict.detected_s - max(begun) if begun else None


def probabilities(verdict: Verdict) -> str:
    """The four most probable hypotheses; what is below 1 % is left out."""
    ranked = sorted(verdict.probability.items(), key=lambda item: -item[1])[:4]
    return ", ".join(f"{fault} {p:.1%}" for fault, p in ranked if p >= 0.01)


def reasons(diagnosis: Diagnosis) -> list[str]:
    """The strongest residuals in words, over the rows in alarm or, without an alarm, over all rows."""
    samples = diagnosis.samples
    rows = telling_rows(samples)
    when = "in alarm" if samples["detection"].max() else "over the whole log"
    found = []
    for name, source in names(samples):
        z = column(samples, f"z.{name}")[rows]
        z = z[np.isfinite(z)]
        if z.size:
            formula = diagnosis.about.residuals.get(name) if diagnosis.about else None
            found.append((abs(z.mean()), _in_words(source, z, when, formula)))
    lines = [text for _, text in sorted(found, reverse=True)[:REASONS]]
    return lines + _runner_up(diagnosis.verdict, samples.filter(pl.Series(rows))) + _same(diagnosis.verdict)


def _in_words(source: str, z: Any, when: str, formula: str | None) -> str:
    kind, _, name = source.partition(".")
    mean, beyond = float(z.mean()), float((np.abs(z) > 3.0).mean())
    strength = "far" if abs(mean) >= 3.0 else "clearly"
    where = (
        f"{strength} {'above' if mean > 0 else 'below'} expectation" if abs(mean) >= 1.0 else "as expected"
    )
    what = f"; it is {formula}" if formula else ""
    return f"{kind} **{name}** is {where} {when}: mean {mean:+.1f} sigma, {beyond:.0%} beyond 3 sigma{what}"


def _runner_up(verdict: Verdict, samples: pl.DataFrame) -> list[str]:
    """How much more evidence the verdict has than the next hypothesis, at its strongest row; of pairs those
    that were likely count."""
    ahead = leads(samples, verdict.fault)
    if not ahead:
        return []
    second = min(ahead, key=lambda name: ahead[name])
    return [
        f"evidence for {verdict.fault}: {ahead['none']:.0f} (log-likelihood ratio to none), "
        f"{abs(ahead[second]):.0f} {'more' if ahead[second] >= 0 else 'less'} than for {second}"
    ]


def _same(verdict: Verdict) -> list[str]:
    """What no log could tell from the verdict."""
    return [
        f"{pair}, both by about as much the other way, would look the same; one fault is likelier than two"
        for pair in verdict.statistics.get("same_as", [])
    ]


def _data(diagnosis: Diagnosis) -> list[str]:
    samples, verdict = diagnosis.samples, diagnosis.verdict
    lines = []
    if "in_domain" in samples.columns and samples.height:
        inside = float(samples["in_domain"].mean() or 0.0)  # type: ignore[arg-type]
        lines.append(f"{inside:.0%} of {samples.height} samples in regimes known from training")
    lines += [*shortcomings(verdict.quality), *quality_events(diagnosis.log), *flagged(diagnosis.log)]
    return lines or ["nothing to remark"]


def _provenance(verdict: Verdict, log: Log) -> str:
    rows = [("log", verdict.log), ("recipe", verdict.recipe), ("detector", verdict.detector or "none")]
    return table(("", "value"), rows + facts(log))


def facts(log: Log) -> list[tuple[str, str]]:
    """Facts about the source that fit on a line."""
    plain = {k: v for k, v in log.facts.items() if isinstance(v, str | int | float) and v != ""}
    plain.pop("path", None)  # where it lay says nothing of the log
    if "file" in plain:
        plain["file"] = PurePath(str(plain["file"])).name
    return [(key.replace("_", " "), short(value)) for key, value in plain.items()][:12]


def regime_table(diagnosis: Diagnosis) -> str:
    """Per residual and regime: samples, mean, sd, the sigma expected, and the mean z without and in alarm."""
    samples = diagnosis.samples.with_columns(alarm=pl.col("detection") > 0)
    parts = []
    for name, source in names(samples):
        value, sigma, z = (
            pl.col(c).cast(pl.Float64).fill_nan(None) for c in (source, f"sigma.{name}", f"z.{name}")
        )
        rows = samples.group_by("regime").agg(
            value.count().alias("samples"),
            value.mean().alias("mean"),
            value.std().alias("sd"),
            sigma.median().alias("sigma"),
            z.filter(~pl.col("alarm")).mean().alias("z, no alarm"),
            z.filter(pl.col("alarm")).mean().alias("z in alarm"),
        )
        rows = rows.filter(pl.col("samples") > 0).sort("regime", nulls_last=True).head(REGIME_ROWS)
        body = [
            [regime_name(-1 if r is None else r) or "–", *map(_number, rest)] for r, *rest in rows.iter_rows()
        ]
        parts.append(f"### {name} [{diagnosis.units.get(name) or '1'}]\n" + table(rows.columns, body))
    return "\n\n".join(parts)


def log_summary(log: Log, remarks: Iterable[str] = ()) -> str:
    """A log without a run: groups, rates, truth, remarks, facts."""
    rows = [
        (g.name, str(g.frame.height), str(len(g.signals)), f"{g.rate_hz:.6g} Hz") for g in log.groups.values()
    ]
    remarks = [*remarks, *quality_events(log), *flagged(log)]
    parts = [
        f"## {log.name}",
        table(("group", "rows", "signals", "rate"), rows),
        "### Injected faults\n" + _bullets(map(injected_text, truth(log)) if truth(log) else ["none"])
        if truth_known(log)
        else "",
        "### Remarks\n" + _bullets(remarks) if remarks else "",
        "### Source\n" + table(("", "value"), facts(log)) if facts(log) else "",
    ]
    return "\n\n".join(part for part in parts if part)


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table.

    >>> print(table(("a", "b"), [("1", "x|y")]))
    | a | b |
    | --- | --- |
    | 1 | x\\|y |
    """
    lines = [list(head)]
    body = [[cell.replace("|", "\\|").replace("\n", " ") for cell in row] for row in rows]
    lines += [["---"] * len(lines[0]), *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _bullets(lines: Iterable[str]) -> str:
    return "\n".join(f"- {line}" for line in lines)


def _number(value: Any) -> str:
    return "–" if value is None else str(value) if isinstance(value, int) else f"{value:.3g}"

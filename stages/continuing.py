"""Continuing: fitted relations go on learning from further logs, without the logs that they learned from.

With its map and blending kept, a relation (:mod:`stages.gsmms`) is determined by sums over rows: Gram matrix
``sum w f f'``, moments ``sum w f y`` and ``sum w y^2`` in blocks for the jackknife, and by region the sums
that say where it knows. Sums of more logs are added, so a fit continued is the fit on all logs at once, to
rounding: the shrinkage ``lambda`` is chosen from the sums, and the rows fill equal blocks one after the
other, pairs of which are merged as soon as there are ``2 BLOCKS``.

Where an output is made from earlier relations, these are the ones that the map was made with
(``reference``); so the sums do not depend on what was learned since. What a region's samples reach is kept
too. A new map takes a fit from scratch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ingest.errors import LogError, RecipeError
from ingest.log import TIME, Log
from stages.gate import GATE
from stages.gsmms import BLOCKS, Gsmms, features, region_spread, shrinkage, solve_blended
from stages.partition import CHUNK
from stages.relation import regressors
from stages.relations import Relations
from stages.stage import Arrays, columns

Array = NDArray[np.float64]
FIRST_BLOCK = 64  # rows


def gather(relations: Relations, blocks: Sequence[Log], earlier: Arrays | None = None) -> Arrays:
    """The sums of ``earlier`` and of the blocks, which have all that the relations need.

    Raises:
        LogError: a relation holds in these logs that has never been fitted.
        RecipeError: a relation's regions are not blended.
    """
    sums: dict[str, NDArray[Any]] = dict(earlier or _empty(relations))
    for block in blocks:
        values = dict(columns(block))
        weight = values.get(GATE, np.ones(len(values[TIME])))
        for name, relation in relations.relations.items():
            holds = relation.holds(values)
            model = relations.models.get(name)
            if model is None:
                if holds.any():
                    raise LogError(
                        f"log {block.name!r}: relation {name!r} holds in it and was never fitted; "
                        "train from scratch, on logs with and without"
                    )
                values[name] = np.zeros(holds.shape)
                continue
            S = regressors(values, relations.inputs(name))
            y, _, own = (np.broadcast_to(f(values), holds.shape) for f in relation.formulas)
            known = holds & np.isfinite(S).all(axis=1) & np.isfinite(y) & (weight > 0)
            part = {k.partition("/")[2]: v for k, v in sums.items() if k.startswith(f"{name}/")}
            part = _added(part, model, S[known], y[known], (weight * own)[known])
            part = _known(part, model, S[known], weight[known])
            sums |= {f"{name}/{k}": v for k, v in part.items()}
            reference = replace(model, theta=sums[f"{name}/reference"])
            values[name] = np.where(holds, reference.predict(S), 0.0)
            if name == relations.regime:
                sums |= _described(sums, relations.map, model, S, known, y - values[name], weight, values)
    return sums


def continued(relations: Relations, sums: Arrays) -> Relations:
    """The relations as ``sums`` say."""
    learned = dict(relations.learned)
    for name, model in relations.models.items():
        part = {k.partition("/")[2]: v for k, v in sums.items() if k.startswith(f"{name}/")}
        learned |= {f"{name}/{k}": v for k, v in _solved(model, part).to_arrays().items()}
    mass = np.maximum(sums["map/mass"], 1e-12)
    return replace(relations, learned={
        **learned, "map/visits": sums["map/visits"],
        "map/nodes": sums["map/centre"] / mass[:, None], "map/spread": np.sqrt(sums["map/square"] / mass),
    })  # fmt: skip


def _empty(relations: Relations) -> dict[str, NDArray[Any]]:
    sums: dict[str, NDArray[Any]] = {}
    for name, model in relations.models.items():
        if model.width == 0:
            raise RecipeError(
                f"relation {name!r}: only blended regions can be continued, of two nodes or more"
            )
        M, d = model.partition.nodes.shape
        p = (M + 1) * (d + 1)
        part = {
            "G": np.zeros((1, p, p)), "h": np.zeros((1, p)), "yy": np.zeros(1), "rows": np.zeros(1),
            "size": np.array(float(FIRST_BLOCK)), "mass": np.zeros(M), "first": np.zeros((M, d)),
            "second": np.zeros((M, d, d)), "reference": model.theta,
        }  # fmt: skip
        sums |= {f"{name}/{k}": v for k, v in part.items()}
    M = len(relations.models[relations.regime].theta)
    one = {"mass": np.zeros(M), "visits": np.zeros(M), "square": np.zeros(M), "centre": np.zeros((M, 2))}
    return sums | {f"map/{k}": v for k, v in one.items()}


def _added(part: Arrays, model: Gsmms, S: Array, y: Array, weight: Array) -> dict[str, Any]:
    """The blocks with further rows."""
    G, h, yy, rows = ([*part[k]] for k in ("G", "h", "yy", "rows"))
    size, at = int(part["size"]), 0
    while at < len(S):
        if rows[-1] >= size:
            if len(rows) == 2 * BLOCKS:
                G, h, yy, rows = (
                    [a + b for a, b in zip(x[::2], x[1::2], strict=True)] for x in (G, h, yy, rows)
                )
                size *= 2
            for x in (G, h, yy, rows):
                x.append(np.zeros_like(x[0]))
        take = slice(at, min(at + size - int(rows[-1]), at + CHUNK, len(S)))
        F = features(S[take], model.partition.nodes, model.width)
        Fw = F * weight[take, None]
        G[-1] = G[-1] + F.T @ Fw
        h[-1] = h[-1] + y[take] @ Fw
        yy[-1] = yy[-1] + float(weight[take] @ y[take] ** 2)
        rows[-1] = rows[-1] + (take.stop - take.start)
        at = take.stop
    return {**part, "G": np.stack(G), "h": np.stack(h), "yy": np.array(yy), "rows": np.array(rows),
            "size": np.array(float(size))}  # fmt: skip


def _known(part: Mapping[str, Any], model: Gsmms, S: Array, weight: Array) -> dict[str, Any]:
    """The sums by region with further rows."""
    unit, M = model.partition.assign(S), len(model.theta)
    first = np.stack([np.bincount(unit, weight * s, minlength=M) for s in S.T], axis=1)
    pairs = [[np.bincount(unit, weight * a * b, minlength=M) for b in S.T] for a in S.T]
    return {
        **part, "mass": part["mass"] + np.bincount(unit, weight, minlength=M),
        "first": part["first"] + first, "second": part["second"] + np.moveaxis(np.array(pairs), 2, 0),
    }  # fmt: skip


def _described(
    sums: Arrays, plane: Sequence[str], model: Gsmms, S: Array, known: NDArray[np.bool_], error: Array,
    weight: Array, values: Mapping[str, Array],
) -> dict[str, NDArray[Any]]:  # fmt: skip
    """The operating map's sums with further rows; errors are those of the reference."""
    unit, M = model.partition.assign(S[known]), len(model.theta)

    def total(x: Array) -> Array:
        return np.asarray(np.bincount(unit, np.nan_to_num(x[known]), minlength=M), dtype=float)

    centre = np.stack([total(weight * values[n]) for n in plane], axis=1)
    return {
        "map/mass": sums["map/mass"] + total(weight),
        "map/visits": sums["map/visits"] + total(np.ones(len(weight))),
        "map/square": sums["map/square"] + total(weight * error**2),
        "map/centre": sums["map/centre"] + centre,
    }


def _solved(model: Gsmms, part: Arrays) -> Gsmms:
    """The model from its sums, by the formulas of a fit."""
    M = len(model.theta)
    G, h, yy = part["G"], part["h"], float(part["yy"].sum())
    N, total = float(G[:, 0, 0].sum()), float(h[:, 0].sum())  # the first feature is 1
    centre = total / N
    scale = float(np.sqrt(max(yy / N - centre**2, 0.0))) or 1.0
    target = (h - centre * G[:, 0]) / scale
    _, prior = shrinkage(G.sum(axis=0), target.sum(axis=0), N, N, M)
    theta, root = solve_blended(G, target, prior, M)
    theta, root = scale * theta, scale * root
    theta[:, 0] += centre
    mean, whiten = region_spread(model.partition.nodes, part["mass"], part["first"], part["second"])
    flat = np.concatenate([np.zeros(theta.shape[1]), theta.ravel()])
    left = yy - 2 * flat @ h.sum(axis=0) + flat @ G.sum(axis=0) @ flat
    return replace(
        model, theta=theta, root=root, rms=float(np.sqrt(max(left, 0.0) / N)), mean=mean, whiten=whiten
    )

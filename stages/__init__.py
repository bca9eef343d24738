"""The mathematics, one algorithm a file: frozen settings, explicit state, no files, no clock."""

from __future__ import annotations

# The stages that a recipe can name with `use`; a user's own is "module:Class".
STAGES = {
    "align": "stages.align:Align",
    "roughness": "stages.roughness:Roughness",
    "smooth": "stages.smooth:Smooth",
    "regressors": "stages.regressors:Regressors",
    "gate": "stages.gate:Gate",
    "normalise": "stages.normalise:Normalise",
    "select_inputs": "stages.select_inputs:SelectInputs",
    "narx": "stages.narx:Narx",
    "relations": "stages.relations:Relations",
    "residuals": "stages.residuals:Residuals",
    "isolate": "stages.isolate:Isolate",
    "pairs": "stages.pairs:Pairs",
    "sensors": "stages.sensors:Sensors",
    "detect": "stages.detect:Detect",
    "signatures": "stages.signatures:Signatures",
    "denoise": "stages.denoise:Denoise",
    "monitor": "stages.monitor:Monitor",
    "compensate": "stages.compensate:Compensate",
}

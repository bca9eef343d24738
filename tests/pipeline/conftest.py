"""Short simulated drives and detectors fitted on them, made once for all tests of the pipeline."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from ingest import write_log
from ingest.log import Log
from ingest.simulators.airpath import simulate_airpath
from ingest.simulators.faults import Fault
from pipeline import fit, load_recipe
from pipeline.detector import Detector
from pipeline.recipe import Recipe
from pipeline.store import Store


@pytest.fixture(scope="session")
def recipe() -> Recipe:
    return load_recipe("diesel_airpath")


@pytest.fixture(scope="session")
def healthy() -> list[Log]:
    return [
        simulate_airpath(cycle="udds", duration_s=400, seed=seed, name=f"healthy{seed}") for seed in (1, 2)
    ]


@pytest.fixture(scope="session")
def faulty() -> Log:
    """8 % too little air mass flow read from 133 s on."""
    fault = Fault(name="maf_gain", magnitude=-0.08)
    return simulate_airpath(cycle="udds", duration_s=400, seed=3, faults=[fault], name="faulty")


@pytest.fixture(scope="session")
def detector(healthy: list[Log], recipe: Recipe) -> Detector:
    """Fitted on one drive, calibrated on another."""
    return fit(healthy[:1], recipe, healthy[1:])


@pytest.fixture(scope="session")
def second(healthy: list[Log], recipe: Recipe) -> Detector:
    """Another detector of the same recipe."""
    return fit([replace(healthy[0], name="again")], recipe, healthy[1:])


@pytest.fixture(scope="session")
def logs(healthy: list[Log], faulty: Log, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the drives as files; not to be changed."""
    folder = tmp_path_factory.mktemp("logs")
    for log in (*healthy, faulty):
        write_log(log, folder / f"{log.name}.parquet")
    return folder


@pytest.fixture(scope="session")
def store(detector: Detector, tmp_path_factory: pytest.TempPathFactory) -> Store:
    """A store with one detector; not to be changed."""
    store = Store(tmp_path_factory.mktemp("store"))
    store.add(detector)
    return store

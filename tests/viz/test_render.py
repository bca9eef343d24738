from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from PIL import Image

from ingest.errors import DynoscopeError
from ingest.log import Group, Log, Signal
from stages.results import RESIDUAL_EDGES, Chosen, Diagnosis
from viz import render
from viz.timeline import write_log_timeline, write_selections, write_timeline

needs_driver = pytest.mark.skipif(
    render.software_driver() is None, reason="no software Vulkan driver: apt-get install mesa-vulkan-drivers"
)


@pytest.fixture(scope="module")
def pictures(diagnosis: Diagnosis, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Image.Image]:
    folder = tmp_path_factory.mktemp("pictures")
    write_timeline(diagnosis, folder / "run.rrd")
    return {
        p.stem: Image.open(p).convert("RGB")
        for p in render.render(folder / "run.rrd", folder / "png", at=260.0)
    }


def coloured(picture: Image.Image, colour: tuple[int, int, int], within: int = 24) -> int:
    """Pixels close to ``colour``."""
    return int((np.abs(np.asarray(picture, dtype=int) - colour).max(axis=2) <= within).sum())


@needs_driver
def test_every_tab_has_its_picture_without_complaints(pictures: dict[str, Image.Image]) -> None:
    assert list(pictures) == [
        "overview",
        "signals",
        "residuals",
        "regimes",
        "evidence",
        "distributions",
        "model",
    ]
    for name, picture in pictures.items():
        assert picture.size == (1920, 1080)
        lit = (np.asarray(picture).max(axis=2) > 60).mean()
        assert lit > 0.01, name


@needs_driver
def test_the_pictures_show_the_whole_time(pictures: dict[str, Image.Image]) -> None:
    """Lines reach both sides: a view that opened on a part around the cursor would show no gap at 7/10."""
    strip = np.asarray(pictures["signals"].crop((0, 100, 1920, 235)), dtype=int)
    blue = (np.abs(strip - (86, 180, 233)).max(axis=2) <= 40).any(axis=0)
    columns = np.flatnonzero(blue)
    assert columns[0] < 60
    assert columns[-1] > 1880
    assert 25 < np.diff(columns).max() < 60  # 14 s of 600 on 1880 pixels


@needs_driver
def test_exceedances_and_the_fault_are_seen(pictures: dict[str, Image.Image]) -> None:
    residuals = pictures["residuals"]
    early, late = residuals.crop((40, 90, 640, 700)), residuals.crop((700, 90, 1900, 700))
    assert coloured(late, (255, 82, 62), 60) > 50 * max(coloured(early, (255, 82, 62), 60), 1)


@needs_driver
def test_a_recording_without_any_time_opens_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render, "TIMEOUT_S", 20.0)
    still = Chosen(
        name="f", output="y", criterion="pooled", proven=True, candidates=("u",), genes=((0,),),
        correlation=((1.0, 0.5), (0.5, 1.0)), scores=(-3.0,), history=(5.0, -3.0),
        residual=(0.125,) * (len(RESIDUAL_EDGES) - 1),
        spectrum=(1.0,),
    )  # fmt: skip
    write_selections([still], "still", tmp_path / "still.rrd")
    with render.viewer() as client:
        render.opened(client, tmp_path / "still.rrd")
        assert list(render.tabs(client))


@needs_driver
def test_every_page_of_a_tab_comes_to_the_front(tmp_path: Path) -> None:
    names = [f"s{i}" for i in range(14)]
    frame = pl.DataFrame({"time": [0.0, 1.0], **{name: [0.0, 1.0] for name in names}})
    group = Group("g", frame, {name: Signal(name=name, unit=name) for name in names})
    write_log_timeline(Log(name="l", groups={"g": group}), tmp_path / "l.rrd")
    with render.viewer() as client:
        render.opened(client, tmp_path / "l.rrd")
        seen = {name: render.settled(client) for name in render.tabs(client)}
    assert list(seen) == ["Overview", "Signals Page 1", "Signals Page 2"]
    assert len(set(seen.values())) == 3


@needs_driver
def test_what_cannot_be_loaded_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render, "TIMEOUT_S", 3.0)
    (tmp_path / "broken.rrd").write_bytes(b"RRF2 and nothing more")
    with pytest.raises(DynoscopeError, match=r"broken\.rrd"):
        render.render(tmp_path / "broken.rrd", tmp_path / "png")


def test_a_missing_driver_is_explained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render, "DRIVERS", tmp_path)
    log = Log(name="l", groups={"g": Group("g", pl.DataFrame({"time": [0.0], "v": [1.0]}))})
    write_log_timeline(log, tmp_path / "l.rrd")
    with pytest.raises(DynoscopeError, match="mesa-vulkan-drivers"):
        render.render(tmp_path / "l.rrd", tmp_path / "png")

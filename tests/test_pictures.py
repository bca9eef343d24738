"""``make pictures`` draws a real run, and its checks fail where they should."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))  # the benchmarks are no package of the program

from benchmarks.pictures import RECIPES, check_picture, check_values, draw, narx
from pipeline import run
from viz.render import software_driver


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of recipe `narx` with its recording."""
    folder = tmp_path_factory.mktemp("narx")
    detector, logs, _ = narx(folder)
    run(logs, detector, folder / "out")
    return folder / "out" / logs[0].stem / "timeline.rrd"


def test_every_recipe_is_drawn() -> None:
    there = {path.stem for path in (Path(__file__).parents[1] / "pipeline/recipes").glob("*.toml")}
    assert set(RECIPES) == there


@pytest.mark.skipif(
    software_driver() is None, reason="no software Vulkan driver: apt-get install mesa-vulkan-drivers"
)
def test_a_recipe_is_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    draw("narx", narx, tmp_path)
    tabs = {path.stem for path in (tmp_path / "narx").iterdir()}
    assert {"overview", "signals", "residuals", "regimes", "evidence", "distributions", "model"} <= tabs
    assert "narx: unknown" in capsys.readouterr().out


def test_a_recording_that_says_something_else_is_found(recording: Path, tmp_path: Path) -> None:
    check_values(recording)
    copy = tmp_path / "timeline.rrd"
    copy.write_bytes(recording.read_bytes())
    samples = pl.read_parquet(recording.with_name("samples.parquet"))
    other = samples.with_columns(pl.col("residual.r_y1") + 1e-9)
    other.write_parquet(tmp_path / "samples.parquet")
    with pytest.raises(SystemExit, match=r"residual\.r_y1"):
        check_values(copy)


def test_a_blank_picture_is_found(tmp_path: Path) -> None:
    pixels = np.full((1080, 1920, 3), 16, dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "blank.png")
    with pytest.raises(SystemExit, match="blank"):
        check_picture(tmp_path / "blank.png")
    pixels[::20] = 200
    Image.fromarray(pixels).save(tmp_path / "drawn.png")
    check_picture(tmp_path / "drawn.png")

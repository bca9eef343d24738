"""Every tab of every recipe as a picture: ``pictures/<recipe>/<tab>.png``, and a batch's report.

    python -m benchmarks.pictures [--out pictures] [--recipe NAME ...] [--liu FOLDER]

Logs are simulated, detectors fitted, logs run as the commands do it, and the recordings drawn by the native
viewer with software Vulkan. It fails if a view reports a problem, a picture is blank, or the recording
says something else than ``samples.parquet``. The petrol engine is made up, or with ``--liu`` the bench's
(FOLDER holds the LiU-ICE logs).
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import polars as pl
import rerun as rr
from PIL import Image

from ingest.log import Event, Group, Log, Signal
from ingest.simulators.airpath import simulate_airpath
from ingest.simulators.examples import simulate_example
from ingest.simulators.faults import Fault
from ingest.simulators.parameters import Plant
from ingest.simulators.throttle import simulate_throttle
from pipeline import fit, load_recipe, run
from pipeline.adapting import adapt
from pipeline.batch import Options
from pipeline.detector import Detector, unfitted_detector
from pipeline.drift import drift_report
from pipeline.replaying import Step, replay
from pipeline.reporting import write_report
from pipeline.viewing import to_show, write_compared
from pipeline.wear import keep_wear
from viz.live import Live
from viz.render import TOASTS_S, render, settled, viewer
from viz.viewer import free_port

ROOT = Path(__file__).parents[1]
Made = tuple[Detector, list[Path], float]
"""A detector, logs to run (the first is drawn), and where the cursor stands, s."""


def diesel_airpath(folder: Path) -> Made:
    """Two fault-free drives to learn from; a leak is drawn, a sensor fault and a healthy drive go with it."""
    from ingest import write_log

    learn = [simulate_airpath(cycle=c, seed=i, name=f"{c}_{i}") for i, c in enumerate(("wltc_3b", "ftp75"))]
    faults = {"boost_leak": 6.0, "boost_pressure_gain": 0.02, "none": 0.0}
    paths = []
    for i, (name, size) in enumerate(faults.items()):
        known = [Fault(name=name, magnitude=size)] if size else []
        log = simulate_airpath(cycle="udds", seed=20 + i, duration_s=760.0, faults=known, name=name)
        paths.append(write_log(log, folder / f"drive_{name}.mcap"))
    return fit(learn[:1], load_recipe("diesel_airpath"), learn[1:]), paths, 275.0


def si_airpath(folder: Path) -> Made:
    """A throttled engine whose air mass flow sensor reads 8 % high from a third of the drive on."""
    from ingest import write_log

    learn = [petrol_drive(seed, f"petrol_{seed}") for seed in (1, 2)]
    paths = [write_log(petrol_drive(3, "petrol_maf", gain=1.08), folder / "petrol_maf.mcap")]
    return fit(learn[:1], load_recipe("si_airpath"), learn[1:]), paths, 260.0


def petrol_drive(seed: int, name: str, gain: float = 1.0, duration: float = 700.0) -> Log:
    """A made-up drive of speed-density and throttle flow, 10 Hz; the sensor's gain is off from a third on."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, duration, 0.1)

    def held(low: float, high: float, hold: float) -> np.ndarray:
        steps = rng.uniform(low, high, int(duration / hold) + 2)[(time / hold).astype(int)]
        kernel = np.hanning(41)
        return np.convolve(np.pad(steps, 20, mode="edge"), kernel / kernel.sum(), mode="valid")

    n, p_int = held(900.0, 3600.0, 17.0), held(35.0, 130.0, 11.0)
    p_bst = np.maximum(p_int, 97.0) + 4.0 + 3e-4 * n
    flow = 3.1e-4 * p_int * n * (1.0 - 2e-5 * (n - 2200.0))  # g/s
    ratio = np.clip(p_int / p_bst, 0.53, 0.999)
    area = flow * np.sqrt(310.0) / p_bst / np.sqrt(ratio**1.43 - ratio**1.71)
    onset = duration / 3.0
    values = {
        "p_Int": p_int, "p_Bst": p_bst, "T_Bst": np.full(time.size, 310.0), "n_Eng": n,
        "W_HFM": flow * np.where(time >= onset, gain, 1.0), "theta_Thr": 100.0 * (area / 420.0) ** 0.6,
        "m_Fuel": flow / 14.7 / (n * 2 / 60 / 1000), "p_Amb": np.full(time.size, 101.0),
        "T_Amb": np.full(time.size, 298.0),
    }  # fmt: skip
    units = dict(zip(values, ("kPa", "kPa", "K", "rpm", "g/s", "%", "mg/stroke", "kPa", "K"), strict=True))
    noisy = {k: v * (1.0 + 0.002 * rng.normal(size=time.size)) for k, v in values.items()}
    group = Group(
        "ecu", pl.DataFrame({"time": time, **noisy}), {k: Signal(name=k, unit=u) for k, u in units.items()}
    )
    truth = Event(t_start=onset, kind="maf_gain", source="truth", magnitude=gain - 1.0, unit="1")
    return Log(name=name, groups={"ecu": group}, events=(truth,) if gain != 1.0 else ())


def liu(logs: Path) -> Callable[[Path], Made]:
    """The petrol engine of the bench: fitted on its fault-free drive, a boost pressure sensor at -10 %."""
    from ingest import read_log
    from ingest.maps import load_map

    def made(folder: Path) -> Made:
        from ingest import write_log

        names = load_map(ROOT / "data/maps/liu_ice.toml")
        log = read_log(logs / "wltp_f_pic_090.csv", names)
        paths = [write_log(log, folder / "bench_boost_sensor.mcap")]
        return fit([read_log(logs / "wltp_NF.csv", names)], load_recipe("si_airpath")), paths, 180.0

    return made


def throttle(folder: Path) -> Made:
    """A throttle whose position sensor weakens by 30 % over 5 s."""
    from ingest import write_log

    fault = Fault(name="tps_gain", magnitude=-0.3, onset_s=20.0, ramp_s=5.0)
    log = simulate_throttle(seed=21, duration_s=40.0, faults=[fault], name="throttle_weak")
    paths = [write_log(log, folder / "throttle_weak.mcap")]
    return unfitted_detector(load_recipe("throttle")), paths, 26.0


def narx(folder: Path) -> Made:
    """Numerical example 1 with an offset on one output from half the log on."""
    from ingest import write_log

    learn = [simulate_example("example1", n=1500, seed=seed, name=f"example_{seed}") for seed in (1, 2)]
    log = simulate_example("example1", n=1500, seed=3, name="example_offset")
    (group,) = log.groups.values()
    frame = group.frame.with_columns(pl.col("y1") + 0.8 * (pl.int_range(pl.len()) >= 750))
    truth = Event(t_start=750.0, kind="sensor_offset", channel="y1", source="truth")
    log = Log(name=log.name, groups={group.name: Group(group.name, frame)}, events=(truth,))
    return fit(learn[:1], load_recipe("narx"), learn[1:]), [write_log(log, folder / "offset.mcap")], 800.0


RECIPES: dict[str, Callable[[Path], Made]] = {
    "diesel_airpath": diesel_airpath, "si_airpath": si_airpath, "throttle": throttle, "narx": narx,
}  # fmt: skip


def draw(name: str, make: Callable[[Path], Made], out: Path) -> None:
    """Run a recipe and draw every tab of its first log; of several logs the batch too."""
    began = time.perf_counter()
    with TemporaryDirectory(prefix="dynoscope-") as temporary:
        folder = Path(temporary)
        detector, logs, cursor = make(folder)
        summary = run(logs, detector, folder / "out", Options())
        shutil.rmtree(out / name, ignore_errors=True)
        recording = folder / "out" / logs[0].stem / "timeline.rrd"
        check_values(recording)
        pictures = render(recording, out / name, at=cursor)
        if len(logs) > 1:
            pictures += batch(folder / "out", out / "batch")
            pictures += vehicle(folder, detector, out / "vehicle")
            pictures += compared(folder, detector, logs[0], out / "compared")
            pictures.append(live(logs[0], detector, out / name / "live.png", cursor + 50.0))
    for picture in pictures:
        check_picture(picture)
    fault = summary["fault"][0]
    print(f"{name}: {fault}, {len(pictures)} pictures in {time.perf_counter() - began:.0f} s", flush=True)


def batch(folder: Path, out: Path) -> list[Path]:
    """The overview of a batch in the viewer, and its report in a browser, dark and light, if there is one."""
    page = write_report(folder)
    out.mkdir(parents=True, exist_ok=True)
    overview, *_ = to_show([str(folder)], None, folder)
    assert isinstance(overview, Path)
    pictures = [path.rename(out / "overview.png") for path in render(overview, out)]
    shutil.copy(page, out / "report.html")
    browser = next((b for b in ("chromium", "chromium-browser", "google-chrome") if shutil.which(b)), None)
    if browser is None:
        print("no Chromium here: the report is not drawn", file=sys.stderr)
        return pictures
    for theme, value in (("dark", 0), ("light", 1)):
        pictures.append(out / f"report_{theme}.png")
        command = [
            browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
            "--window-size=1400,1900", f"--blink-settings=preferredColorScheme={value}",
            f"--screenshot={pictures[-1].resolve()}", page.resolve().as_uri(),
        ]  # fmt: skip
        subprocess.run(command, check=True, capture_output=True, timeout=120)
    return pictures


def vehicle(folder: Path, detector: Detector, out: Path) -> list[Path]:
    """Drift and wear of a vehicle whose intake clogs from drive 8 on, and whose air mass flow sensor weakens
    in the end."""
    from ingest import write_log

    clean, logs, kept = Plant().A_Thr, [], folder / "vehicle"
    for day in range(24):
        weak = [Fault(name="maf_gain", magnitude=-0.05, onset_s=0.0)] if day >= 19 else []
        clogged = {"A_Thr": clean / np.sqrt(1.0 + 0.003 * max(day - 8, 0))}
        log = simulate_airpath(
            cycle="udds",
            duration_s=300.0,
            seed=200 + day,
            name=f"day{day:02d}",
            overrides=clogged,
            faults=weak,
        )
        logs.append(log)
    paths = [write_log(log, folder / f"{log.name}.parquet") for log in logs]
    run(paths, detector, kept, Options(timeline=False))
    drift_report(kept)
    keep_wear(kept, adapt(logs, detector, commissioning=8))
    overview, *_ = to_show([str(kept)], None, folder)
    assert isinstance(overview, Path)
    return render(overview, out)


def compared(folder: Path, detector: Detector, path: Path, out: Path) -> list[Path]:
    """The detector and one that has learned from another drive, on one log."""
    from ingest import read_log

    learn = [simulate_airpath(cycle=c, seed=7, name=c) for c in ("us06", "udds")]
    challenger = fit(learn[:1], load_recipe("diesel_airpath"), learn[1:])
    write_compared(detector, challenger, [read_log(path)], folder / "compared.rrd")
    return render(folder / "compared.rrd", out, at=275.0)


def live(path: Path, detector: Detector, picture: Path, until: float) -> Path:
    """A replay as it stands ``until`` seconds into the log, in a viewer that is open meanwhile."""
    from ingest import read_log

    log = read_log(path)
    rec = rr.RecordingStream("dynoscope live", send_properties=False)
    rec.set_log_time_enabled(False)
    drawn: list[Live] = []

    def step(one: Step) -> None:
        if not drawn:
            drawn.append(Live(rec, log, one.samples, one.plane))
        if one.part is not None and one.part.span[1] <= until:
            drawn[0].step(one.part, one.samples, one.plane)

    port = free_port()
    with viewer(port) as client:
        rec.connect_grpc(f"rerun+http://127.0.0.1:{port}/proxy")
        replay(log, detector, step)
        rec.flush()
        time.sleep(TOASTS_S)
        picture.write_bytes(settled(client))
        rec.disconnect()
    return picture


def check_picture(path: Path) -> None:
    """A picture is of its size, and not of one colour."""
    pixels = np.asarray(Image.open(path).convert("L"), dtype=int)
    stands_out = float((np.abs(pixels - np.median(pixels)) > 40).mean())
    if stands_out < 0.01:
        raise SystemExit(f"{path} is blank: {stands_out:.2%} of its pixels stand out")


def check_values(recording: Path) -> None:
    """Every residual in the recording equals that of ``samples.parquet``."""
    from rerun.chunk import RrdReader

    samples = pl.read_parquet(recording.with_name("samples.parquet"))
    drawn: dict[str, list[float]] = {}
    for chunk in RrdReader(recording).stream():
        batch_ = chunk.to_record_batch()
        if not chunk.is_static and "Scalars:scalars" in batch_.schema.names:
            drawn.setdefault(str(chunk.entity_path), []).extend(
                v[0] for v in batch_["Scalars:scalars"].to_pylist()
            )
    for column in samples.columns:
        kind, _, name = column.partition(".")
        if kind in ("residual", "indicator"):
            (found,) = (v for k, v in drawn.items() if k.replace("\\", "") == f"/residuals/{name}/value")
            kept = np.array(found)[np.isfinite(found)]
            known = samples[column].drop_nans().drop_nulls().to_numpy()
            if not np.array_equal(kept, known):
                raise SystemExit(f"{recording}: {column} is not that of samples.parquet")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("pictures"))
    parser.add_argument("--recipe", nargs="+", choices=RECIPES, default=list(RECIPES))
    parser.add_argument("--liu", type=Path, metavar="FOLDER")
    args = parser.parse_args()
    for name in args.recipe:
        make = liu(args.liu) if args.liu and name == "si_airpath" else RECIPES[name]
        draw(name, make, args.out)


if __name__ == "__main__":
    main()

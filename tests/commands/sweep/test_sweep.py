from __future__ import annotations

import csv
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from pnpdepth_cli.commands.refinement import refine as refining
from pnpdepth_cli.commands.refinement.inputs import Inputs, read_inputs
from pnpdepth_cli.commands.refinement.refine import refine_image
from pnpdepth_cli.commands.refinement.request import RefineRequest
from pnpdepth_cli.commands.sparse.options import ScanOptions
from pnpdepth_cli.commands.sweep.axes import read_axis, studies_of
from pnpdepth_cli.commands.sweep.outputs import (
    METHODS,
    SWEPT,
    across_and_apart,
    draw_study,
    summarise,
)
from pnpdepth_cli.commands.sweep.points import Sampling, frame_points, read_sampling
from pnpdepth_cli.commands.sweep.sweep import SweepRequest, run_sweep
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.errors import InputError, OutputError, PnpDepthError, UsageError
from pnpdepth_cli.frames import refiner as frame_refiner
from pnpdepth_cli.io.dataset import Frame, Protocol
from pnpdepth_cli.sensors import (
    FORWARD_LEFT_UP,
    LIDARS,
    Camera,
    SampleNoise,
    SamplePattern,
    sample_points,
    simulate_lidar,
)
from tests.commands.batches import RecordingListener, pairs_on_disk, refinement

CALIB = "60 0 31\n0 60 23\n0 0 1\n"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return pairs_on_disk(tmp_path / "drive", ("a", "b"))


def sweep(
    root: Path,
    *vary: str,
    listener: RecordingListener | None = None,
    one_by_one: bool = False,
    refine: dict[str, Any] | None = None,
    **changes: Any,
) -> dict[str, Any]:
    fields: dict[str, Any] = {
        "source": root,
        "output": root / "out",
        "refine": refinement(root, **(refine or {})),
        "studies": studies_of([read_axis(text) for text in vary], one_by_one=one_by_one),
        "plots": "none",
        "resamples": 50,
    }
    return run_sweep(SweepRequest(**fields | changes), listener or RecordingListener())


def one_frame(root: Path, **changes: Any) -> tuple[RefineRequest, Inputs]:
    files = {part: root / part / "a.png" for part in ("sparse", "gt")}
    request = refinement(root, image=root / "rgb/a.png", **files, **changes)
    return request, read_inputs(request)


def alone(root: Path, **changes: Any) -> dict[str, Any]:
    """The scores before and after of frame a by `pnpdepth refine`."""
    request, _ = one_frame(root, output=root / "alone.npy", overwrite=True, **changes)
    scores: dict[str, Any] = refine_image(request).record["scores"]
    return scores


def journal(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "sweep.jsonl").read_text().splitlines()]


def lines(root: Path, name: str = "sweep_frames.csv", **wanted: str) -> list[dict[str, str]]:
    """The lines of a table that have these values."""
    with (root / "out" / name).open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return [row for row in rows if wanted.items() <= row.items()]


class Killed(RecordingListener):
    """Somebody who kills the sweep after so many runs."""

    def __init__(self, after: int) -> None:
        super().__init__()
        self._after = after

    def frame(self, row: dict[str, Any]) -> None:
        super().frame(row)
        if len(self.rows) == self._after:
            raise KeyboardInterrupt


# what is computed


REFINEMENTS: list[dict[str, Any]] = [
    {"iterations": 2, "lr": "10%"},
    {"iterations": 8, "lr": "60%", "keep_best": True},
    {"iterations": 4, "schedule": "linear"},
    {"iterations": 0, "propagate": "gp"},
    {"iterations": 3, "lr": "0.001", "parameters": "weights"},
    {"preset": "paper", "propagate": None},
]


@pytest.mark.parametrize("settings", REFINEMENTS, ids=lambda settings: str(list(settings)))
def test_a_row_has_the_scores_of_refine_and_of_linear_interpolation(
    root: Path, settings: dict[str, Any]
) -> None:
    sweep(root, "points=60,20", refine=settings)
    (line,) = lines(root, frame="a", points="60")
    wanted = alone(root, **settings)
    _, inputs = one_frame(root)
    assert inputs.gt is not None
    interpolated = score(linear(inputs.points), torch.from_numpy(inputs.gt))
    for key in ("rmse", "mae", "mre", "delta1"):
        assert float(line[f"{key}_refined"]) == wanted["after"][key]
        assert float(line[f"{key}_plain"]) == wanted["before"][key]
        assert float(line[f"{key}_linear"]) == getattr(interpolated, key)
    assert (line["status"], line["points_used"]) == ("done", "60")


def test_a_grid_loads_the_network_once(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded: list[object] = []
    own = refining.load_network
    monkeypatch.setattr(refining, "load_network", lambda *a, **k: loaded.append(a) or own(*a, **k))
    sweep(root, "layer=encode,1", "lr=1%,10%")
    assert len(loaded) == 1


def test_the_tables_say_which_scale_of_the_files_is_assumed(root: Path) -> None:
    for path in (root / "gt").iterdir():
        millimetres = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        codes = (millimetres * 0.256).round().astype(np.uint16)
        cv2.imwrite(str(path), codes)  # without the scale in its text
    record = sweep(root, "iterations=1")
    assert record["assumed"] == ["gt: 16-bit PNG ÷ 256, assumed"]
    first, *_ = (root / "out" / "sweep.tex").read_text().splitlines()
    assert first.endswith("gains over plain in %; gt: 16-bit PNG ÷ 256, assumed")


def test_one_by_one_shares_what_the_tables_have_in_common(root: Path) -> None:
    record = sweep(root, "iterations=1,5", "lr=0.01,0.1", "loss=l1,l2", one_by_one=True)
    assert [study["name"] for study in record["studies"]] == ["iterations", "lr", "loss"]
    # 5 updates with lr 0.01 and l1 are in all three tables
    assert len(journal(root / "out")) == 2 * 4
    same = [record["studies"][n]["cells"][k]["measures"] for n, k in ((0, 1), (1, 0), (2, 0))]
    assert same[0] == same[1] == same[2]


def test_where_no_layer_is_named_the_cut_is_that_of_refine(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frame_refiner, "default_layer", lambda network, size, count: "encode")
    record = sweep(root, "iterations=0,2")
    assert record["base"]["layer"] == "encode"
    named = sweep(root, "iterations=0,2", refine={"layer": "encode"}, output=root / "named")
    assert record["studies"] == named["studies"]


def test_a_refinement_that_diverges_counts_with_its_last_good_depth(root: Path) -> None:
    model = root / "net/my_net.py"
    formula = "2 + 3 * self.decode(torch.tanh(self.middle(self.encode(rgb))))"
    exponential = "torch.exp(self.decode(self.middle(self.encode(rgb))))"
    model.write_text(model.read_text().replace(formula, exponential))
    listener = RecordingListener()
    record = sweep(root, "lr=0.01,1e4", "iterations=0,5", listener=listener)
    assert [cell["diverged"] for cell in record["studies"][0]["cells"]] == [0, 0, 0, 2]
    (line,) = lines(root, status="diverged", frame="a")
    assert float(line["mae_refined"]) == alone(root, lr="1e4", iterations=5)["after"]["mae"]
    (message, _) = [row["message"] for row in listener.rows if row["status"] == "diverged"]
    assert "try a smaller --lr" in message


# going on


def test_the_same_command_again_computes_nothing_and_writes_the_same(root: Path) -> None:
    vary = ("points=20,60", "iterations=0,2")
    written = []
    for runs in (2 * 2 * 2 * 2, 0):
        listener = RecordingListener()
        sweep(root, *vary, seeds=2, plots="svg", cost=True, listener=listener)
        assert (listener.to_do, len(listener.rows)) == (runs, runs)
        written.append({path.name: path.read_bytes() for path in (root / "out").iterdir()})
    assert written[0] == written[1]
    assert set(written[0]) > {"sweep.csv", "sweep.json", "sweep.tex", "sweep_points_iterations.svg"}


def spoil_image(root: Path) -> None:
    cv2.imwrite(str(root / "rgb/b.png"), np.zeros((46, 62, 3), np.uint8))


def spoil_network(root: Path) -> None:
    network = root / "net/my_net.py"
    network.write_text(network.read_text().replace("2 + 3 *", "2 + 4 *"))


AGAIN: list[tuple[tuple[str, ...], Any, int]] = [
    (("points=20,60", "iterations=1"), None, 0),
    (("points=20", "iterations=1,2"), None, 2),  # a refinement of each frame
    (("lr=0.01,0.1", "points=20"), None, 2),  # lr 0.01 is the network's default
    (("sensor=uniform:30,own", "iterations=1"), None, 2 * 2),
    (("points=20,60", "iterations=1,5"), spoil_image, 4),
    (("points=20,60", "iterations=1,5"), spoil_network, 8),
]


@pytest.mark.parametrize(("vary", "change", "runs"), AGAIN)
def test_only_what_is_missing_or_made_of_other_files_is_computed(
    root: Path, vary: tuple[str, ...], change: Any, runs: int
) -> None:
    sweep(root, "points=20,60", "iterations=1,5")
    if change is not None:
        change(root)
    listener = RecordingListener()
    grown = sweep(root, *vary, listener=listener)
    assert listener.to_do == runs
    assert grown["studies"] == sweep(root, *vary, output=root / "fresh")["studies"]


def test_a_sweep_that_was_killed_goes_on_and_ends_the_same(root: Path) -> None:
    vary = ("points=20,60", "iterations=0,3")
    with pytest.raises(KeyboardInterrupt):
        sweep(root, *vary, listener=Killed(3))
    path = root / "out/sweep.jsonl"
    first, *others = path.read_text().splitlines(keepends=True)
    strange = ["[]", "{}", first.replace('"mae"', '"mea"').strip(), '{"run": 1}', "1e999"]
    path.write_text("".join(["damaged\n", *(f"{text}\n" for text in strange), *others, first[:40]]))
    for left in (6, 0):
        listener = RecordingListener()
        resumed = sweep(root, *vary, listener=listener)
        assert listener.to_do == left
    assert resumed["studies"] == sweep(root, *vary, output=root / "other")["studies"]


# points


def test_points_of_a_pattern_are_those_of_sample_with_the_same_seed(root: Path) -> None:
    request, inputs = one_frame(root)
    sampling = replace(read_sampling("uniform:30"), noise=0.1, outliers=0.2, jitter=0.3)
    points = frame_points(sampling, 7, inputs, request, Frame(name="a"))
    assert inputs.gt is not None
    noise = SampleNoise(metres=0.1, outliers=0.2, jitter_px=0.3)
    wanted = sample_points(inputs.gt, SamplePattern(count=30), 7, noise=noise)
    assert np.array_equal(points.xy.numpy(), wanted.xy)
    assert np.array_equal(points.depth.numpy(), wanted.depth)


def test_a_lidar_stands_where_the_camera_is(root: Path, tmp_path: Path) -> None:
    calib = tmp_path / "calib.txt"
    calib.write_text(CALIB)
    request, inputs = one_frame(root)
    sampling = Sampling(sensor="vlp-16", rotation_noise=2)
    points = frame_points(sampling, 3, inputs, request, Frame(name="a", calib=calib))
    k = np.array([[60, 0, 31], [0, 60, 23], [0, 0, 1.0]])
    camera = Camera(intrinsics=k, rotation=FORWARD_LEFT_UP, translation=np.zeros(3))
    assert inputs.gt is not None
    scanner = replace(LIDARS["vlp-16"], rotation_noise_deg=2)
    wanted = simulate_lidar(inputs.gt, camera, scanner, 3)
    assert np.array_equal(points.xy.numpy(), wanted.xy)
    assert np.array_equal(points.depth.numpy(), wanted.depth)


@pytest.mark.parametrize("cut", [{"halved": True}, {"crop": (20, 30)}], ids=["halved", "cropped"])
def test_a_lidar_needs_the_image_of_the_calibration(
    root: Path, tmp_path: Path, cut: dict[str, Any]
) -> None:
    calib = tmp_path / "calib.txt"
    calib.write_text(CALIB)
    request, inputs = one_frame(root)
    request = request.with_fields(protocol=Protocol(name="cut", **cut))
    with pytest.raises(InputError, match=r"but protocol 'cut' crops it; --protocol whole does not"):
        frame_points(Sampling(sensor="vlp-16"), 0, inputs, request, Frame(name="a", calib=calib))


def test_so_many_of_the_frames_own_points_are_among_them(root: Path) -> None:
    request, inputs = one_frame(root)
    own = {tuple(xy) for xy in inputs.points.xy.tolist()}
    for points, count in (("20", 20), ("50%", 30), ("100%", 60), (None, 60)):
        sampled = frame_points(Sampling(points=points), 0, inputs, request, Frame(name="a"))
        kept = {tuple(xy) for xy in sampled.xy.tolist()}
        assert len(kept) == count
        assert kept <= own
    with pytest.raises(InputError, match=r"\b61 points of 60; ask for fewer"):
        frame_points(Sampling(points="61"), 0, inputs, request, Frame(name="a"))


def test_seeds_draw_other_points_and_only_where_something_is_random(root: Path) -> None:
    sweep(root, "sensor=own,grid:40,uniform:40", seeds=3, refine={"seed": 5})
    seeds: dict[str, list[int]] = {}
    for line in journal(root / "out"):
        if line["frame"] == "a":
            seeds.setdefault(line["points"], []).append(line["seed"])
    assert sorted(map(len, seeds.values())) == [1, 1, 3]
    rows = lines(root, sensor="uniform:40", frame="a")
    assert len({row["mae_linear"] for row in rows}) == 3


def test_the_count_of_sample_is_of_its_pattern_and_not_of_other_sensors(
    root: Path, tmp_path: Path
) -> None:
    calib = tmp_path / "calib.txt"
    calib.write_text(CALIB)
    record = sweep(
        root,
        "sensor=uniform,grid,own,vlp-16",
        sampling=read_sampling("30"),
        refine={"scan": ScanOptions(calib=calib)},
    )
    points = [cell["points"] for cell in record["studies"][0]["cells"]]
    assert points[0] == 30
    assert 20 < points[1] < 40
    assert points[2] == 60
    assert points[3] > 500


def test_frames_without_sparse_depth_have_points_of_the_truth(root: Path, tmp_path: Path) -> None:
    listed = tmp_path / "frames.csv"
    listed.write_text(f"image,gt\n{root}/rgb/a.png,{root}/gt/a.png\n")
    listener = RecordingListener()
    sweep(root, "points=10,5%", source=listed, listener=listener)
    assert any("points: uniform of the ground truth" in text for text in listener.messages)
    with pytest.raises(UsageError, match="needs a number of points"):
        sweep(root, "lr=1%,3%", source=listed)


# means


def row(frame: str, seed: int, refined: Sequence[float], plain: float = 2.0) -> dict[str, Any]:
    """Scores of one frame; the measures are rmse, mae, mre and δ1."""
    scores = {
        f"{measure.key}_{method}": value
        for measure, after in zip(SWEPT, refined, strict=True)
        for method, value in zip(METHODS, (plain, 4.0, after), strict=True)
    }
    return {"frame": frame, "seed": seed, "status": "done", "points_used": 10 * (seed + 1),
            "time_s": 1.0 + seed, **scores}  # fmt: skip


def test_a_mean_is_over_frames_of_each_frames_mean_over_seeds() -> None:
    summary = summarise(
        [row("a", 0, [1, 1, 1, 3]), row("a", 1, [2, 1, 1, 3]), row("b", 0, [3, 1, 1, 3])],
        resamples=200,
    )
    rmse, mae, delta1 = (summary["measures"][key] for key in ("rmse", "mae", "delta1"))
    assert summary["frames"] == 2
    assert rmse["refined"] == (1.5 + 3) / 2
    assert (rmse["refined_low"], rmse["refined_high"]) == (None, None)  # of two frames
    assert mae["gain"] == 50
    assert mae["gain_over_linear"] == 75
    assert delta1["gain"] == 50  # of δ1 more is better
    assert delta1["gain_over_linear"] == -25
    assert summary["points"] == (10 + 20 + 10) / 3
    assert summary["time_s"] == (1 + 2 + 1) / 3


def test_the_interval_of_a_cell_is_over_its_frames() -> None:
    rows = [
        row(name, 0, [value, 1, 1, 3])
        for name, value in zip("abcdef", (3, 6, 1, 5, 2, 4), strict=True)
    ]
    rmse, mae = (summarise(rows, resamples=500)["measures"][key] for key in ("rmse", "mae"))
    assert 1 < rmse["refined_low"] < rmse["refined"] == 3.5 < rmse["refined_high"]
    assert rmse["gain_low"] < rmse["gain"] < rmse["gain_high"]
    assert (mae["gain_low"], mae["gain_high"]) == pytest.approx((50, 50))
    two_sequences = [row(f"{of}_{n:03}", 0, [1, 1, 1, 3]) for of in "ab" for n in range(3)]
    assert summarise(two_sequences, resamples=50)["measures"]["rmse"]["refined_low"] is None


# what can be wrong


def test_a_failed_frame_is_reported_counted_and_left_out_of_the_mean(root: Path) -> None:
    (root / "rgb/b.png").write_bytes(b"")
    for done in (["a", "a", "b", "b"], ["b", "b"]):  # it is tried again
        listener = RecordingListener()
        record = sweep(root, "iterations=0,2", listener=listener)
        assert listener.names == done
        assert [row["status"] for row in listener.rows if row["name"] == "b"] == ["failed"] * 2
    cell = record["studies"][0]["cells"][1]
    assert (cell["frames"], cell["failed"]) == (1, 1)
    mae = cell["measures"]["mae"]
    assert (mae["refined"], mae["refined_low"]) == (alone(root, iterations=2)["after"]["mae"], None)


def test_frames_without_ground_truth_are_reported(root: Path) -> None:
    (root / "gt/a.png").unlink()
    listener = RecordingListener()
    assert sweep(root, "iterations=0,2", listener=listener)["frames"] == ["b"]
    assert "warning: 1 frames have no ground truth and are left out" in listener.messages


def test_a_folder_that_holds_other_results_is_refused(root: Path) -> None:
    out = root / "out"
    out.mkdir()
    (out / "sweep.csv").write_text("mine")
    with pytest.raises(OutputError, match="no sweep wrote it"):
        sweep(root, "iterations=0,2")
    assert (out / "sweep.csv").read_text() == "mine"


BAD = [
    ("point=20", "no parameter 'point'"),
    ("points", "give values after ="),
    ("points=20,", "with commas"),
    ("points=20,20", "comes twice"),
    ("points=many", "neither a number"),
    ("points=0", "at least one point"),
    ("points=200%", "at most 100 %"),
    ("iterations=1.5", "not a whole number"),
    ("lr=0", "a step size above 0"),
    ("loss=l3", "one of l1, l2"),
    ("outliers=2", "from 0 to 1"),
    ("noise=-1", "not negative"),
    ("noise=nan", "not negative"),
    ("noise=x", "'x' is not a number"),
    ("line-search=yes", "neither on nor off"),
    ("rotation-noise=400", "0 to 360"),
    ("seed=99999999999999999999", "largest seed"),
    ("sensor=vlp-17", "no sensor 'vlp-17'"),
    ("sensor=gird:40", "no sensor 'gird:40'"),
    ("sensor=grid:x", "neither a number"),
    ("sensor=no.toml", "no.toml"),
]


@pytest.mark.parametrize(("text", "message"), BAD)
def test_what_cannot_be_varied_is_named_with_the_way_out(text: str, message: str) -> None:
    with pytest.raises(PnpDepthError) as raised:
        read_axis(text)
    assert message in str(raised.value)
    assert raised.value.exit_code in (2, 3)


def test_more_than_two_make_no_grid() -> None:
    axes = [read_axis(text) for text in ("points=1,2", "lr=1,2", "loss=l1,l2")]
    with pytest.raises(UsageError, match="--one-by-one"):
        studies_of(axes, one_by_one=False)
    assert len(studies_of(axes, one_by_one=True)) == 3
    with pytest.raises(UsageError, match="two --vary"):
        studies_of([axes[0], axes[0]], one_by_one=True)


def test_a_sensor_with_its_own_number_does_not_go_with_points(root: Path) -> None:
    with pytest.raises(UsageError, match="says how many points"):
        sweep(root, "points=20,40", "sensor=grid:30,uniform")


# plots


def test_every_study_has_a_plot(root: Path) -> None:
    record = sweep(
        root, "layer=0,1", "loss=l1,log", "points=20,50%", one_by_one=True, plots="png", seeds=2
    )
    for study in record["studies"]:
        plot = cv2.imread(str(root / "out" / study["plot"]))
        assert plot.shape == (580, 1640, 3)
        assert (plot < 128).mean() > 0.005


def test_the_cost_stands_beside_the_error_where_it_is_asked_for(root: Path) -> None:
    record = sweep(root, "iterations=0,40", cost=True, plots="pdf")
    times = [cell["time_s"] for cell in record["studies"][0]["cells"]]
    assert 0 < times[0] < times[1]
    assert [float(row["time_s"]) for row in lines(root, "sweep.csv")] == times
    assert (root / "out" / "sweep_iterations.pdf").read_bytes().startswith(b"%PDF")
    assert "time_s" not in sweep(root, "iterations=0,40")["studies"][0]["cells"][0]


@pytest.fixture
def drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Draws the study of some axes: its cells, of six frames, and the figure that is saved."""
    figure, figures = pytest.importorskip("matplotlib.figure").Figure, list[Any]()
    save = figure.savefig
    monkeypatch.setattr(figure, "savefig", lambda *a, **k: (figures.append(a[0]), save(*a, **k)))

    def draw(*vary: str) -> tuple[list[dict[str, Any]], Any]:
        (study,) = studies_of([read_axis(text) for text in vary], one_by_one=False)
        cells = []
        for number, parameters in enumerate(study.cells()):
            of_frames = zip("abcdef", (3, 6, 1, 5, 2, 4), strict=True)
            rows = [row(name, 0, [n, number + 1, 1, 3], plain=n + 1) for name, n in of_frames]
            cells.append(summarise(rows, 50) | {"parameters": parameters})
        draw_study(study, cells, tmp_path / "plot.png")
        return cells, figures[-1]

    return draw


@pytest.mark.parametrize(
    ("vary", "order", "at", "aside", "scale"),
    [
        ("lr=4,1,2", [1, 2, 0], [1, 2, 4], 0, "log"),
        ("seed=4,1,2", [1, 2, 0], [1, 2, 4], 0, "linear"),
        ("loss=l2,log,l1", [0, 1, 2], [0, 1, 2], 0.1, "linear"),
    ],
)
def test_a_plot_shows_errors_costs_and_gains_with_their_intervals(
    vary: str, order: list[int], at: list[float], aside: float, scale: str,
    drawn: Callable[..., Any],
) -> None:  # fmt: skip
    cells, figure = drawn(vary)
    error, gained, cost = figure.axes
    ordered = [cells[number] for number in order]

    def points(key: str, name: str, shift: float = 0) -> list[tuple[float, float]]:
        shown = [cell["measures"][key][name] for cell in ordered]
        return [(x + shift, y) for x, y in zip(at, shown, strict=True)]

    lines = [line.get_xydata().tolist() for line in (*error.get_lines(), *gained.get_lines())]
    names = ("refined", "plain", "linear")
    expected = [points("mae", name) for name in names] + [points("mae", "gain")]
    assert [line for line in lines if len(line) == 3] == [
        [list(point) for point in line] for line in [*expected, points("rmse", "gain", aside)]
    ]
    styles = [line.get_linestyle() for line in gained.get_lines()[:2]]
    assert styles == (["None"] * 2 if aside else ["-"] * 2)
    for key, drawing in zip(("mae", "rmse"), gained.collections, strict=True):
        ends = {y for name in ("gain_low", "gain_high") for _, y in points(key, name)}
        corners = np.concatenate([path.vertices for path in drawing.get_paths()])
        assert {*corners[:, 1]} == ends
    assert not error.collections
    assert error.get_xscale() == scale
    legend = {"refined", "plain network", "linear interpolation", "refined, RMSE"}
    assert {text.get_text() for text in figure.legends[0].get_texts()} == legend
    ticks = zip(error.get_xticks(), error.get_xticklabels(), strict=True)
    assert {tick: label.get_text() for tick, label in ticks} == {
        x: next(iter(cell["parameters"].values())) for x, cell in zip(at, ordered, strict=True)
    }
    expected = [(cell["time_s"], cell["measures"]["mae"]["refined"]) for cell in cells]
    assert [tuple(line.get_xydata()[0]) for line in cost.get_lines()] == expected


def test_a_grid_has_a_line_for_each_value_of_the_other_axis(drawn: Callable[..., Any]) -> None:
    cells, figure = drawn("lr=1,2,4", "loss=l1,log")
    lines = {line.get_label(): line.get_ydata().tolist() for line in figure.axes[0].get_lines()}
    for loss in ("l1", "log"):
        of_loss = [cell for cell in cells if cell["parameters"]["loss"] == loss]
        assert lines[loss] == [cell["measures"]["mae"]["refined"] for cell in of_loss]
    legend = {text.get_text() for text in figure.legends[0].get_texts()}
    assert legend == {"l1", "log", "plain network", "linear interpolation"}


@pytest.mark.parametrize(
    ("first", "second", "along"),
    [
        ("points=20,60", "iterations=0,1,2", "iterations"),
        ("iterations=0,1,2", "points=20,60", "iterations"),
        ("loss=l1,l2,log", "lr=1%,3%", "lr"),
        ("loss=l1,l2,log", "update=sign,sgd", "loss"),
        ("points=20,60", "lr=1%,3%", "lr"),
    ],
)
def test_numbers_are_on_the_x_axis_and_more_values_before_fewer(
    first: str, second: str, along: str
) -> None:
    axes = read_axis(first), read_axis(second)
    assert across_and_apart(*axes)[0].name == along
    assert across_and_apart(*axes)[1].name in {axis.name for axis in axes} - {along}


def test_axes_have_units_and_numbers_only_where_all_values_are_of_one_kind() -> None:
    assert read_axis("lr=1%,3%").title() == "step (% of the deviation of z)"
    assert read_axis("lr=0.01,0.1").title() == "step"
    assert read_axis("lr=0.01,3%").numbers() is None
    assert read_axis("layer=0,0.5").title() == "layer cut at (0 first, 1 last)"
    assert read_axis("layer=encode,middle").title() == "layer cut at"
    assert read_axis("points=1%,100%").numbers() == [1, 100]


def test_without_matplotlib_an_error_names_the_extra_at_once(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setattr("pnpdepth_cli.commands.sweep.outputs.find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"pip install 'pnpdepth\[plot\]'"):
        sweep(root, "iterations=0,2", plots="png")
    assert not (root / "out").exists()
    assert sweep(root, "iterations=0,2")["studies"][0]["plot"] is None


def test_each_network_has_its_own_cells(root: Path) -> None:
    net, weights = root / "net" / "my_net.py", root / "net" / "my_net.safetensors"
    other = root / "net" / "other.safetensors"
    state = {name: 1.1 * value for name, value in load_file(weights).items()}
    save_file(state, other)
    models = [f"{net}@{weights}", f"{net}@{other}"]
    record = sweep(root, f"model={','.join(models)}", "points=20,60", refine={"checkpoint": None})
    cells = record["studies"][0]["cells"]
    assert [cell["parameters"]["model"] for cell in cells] == [m for m in models for _ in range(2)]
    for model, checkpoint in zip(models, (weights, other), strict=True):
        alone = sweep(
            root, "points=20,60", refine={"checkpoint": checkpoint}, output=root / checkpoint.stem
        )
        own = [cell["measures"] for cell in cells if cell["parameters"]["model"] == model]
        assert own == [cell["measures"] for cell in alone["studies"][0]["cells"]]
    assert cells[0]["measures"] != cells[2]["measures"]
    assert [record["model"]["checkpoint"], record["more_models"][0]["checkpoint"]] == [
        str(weights),
        str(other),
    ]
    with pytest.raises(UsageError, match="vary model=NETWORK@WEIGHTS"):
        sweep(root, f"model={net}")


def test_each_seed_is_a_draw_of_the_points(root: Path) -> None:
    record = sweep(root, "seed=0,3", sampling=read_sampling("40"))
    drawn = [cell["measures"]["mae"]["refined"] for cell in record["studies"][0]["cells"]]
    sweep(root, "points=40", seeds=4, sampling=read_sampling("40"))
    for seed, value in zip((0, 3), drawn, strict=True):
        own = [float(row["mae_refined"]) for row in lines(root, seed=str(seed))]
        assert value == pytest.approx(np.mean(own))

"""The report: what it says, that it stands alone, and that names from files stay text."""

import dataclasses
import html.parser
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmarine import _numbers
from jaxmarine._errors import InputError
from jaxmarine._types import CHANNELS, DOFS
from jaxmarine.diagnosis import (
    Alternative,
    BeforeAfter,
    Diagnosis,
    Dropped,
    Finding,
    Gain,
    LogGain,
    MissingWrench,
    Parameter,
    Predictions,
    Recalibrated,
    Weighed,
)
from jaxmarine.effects import CATALOGUE, Waves
from jaxmarine.fitting import AxisCheck, Check
from jaxmarine.fitting._coverage import AxisCoverage
from jaxmarine.reports import _causes, _curves, _figures, _page, _pictures, _svg, _words, _write, write_report
from jaxmarine.vehicle import Body, Damping, Thrusters, Vehicle

PLANAR = ("surge", "sway", "yaw")
TRAIN = ("run1.csv", "run2.csv", "run3.csv")
EVIL = "<script>alert(1)</script>"


def vehicle(name: str = "catamaran", dof: tuple[str, ...] = PLANAR) -> Vehicle:
    diagonal = jnp.diag(jnp.array([55.0, 55.0, 55.0, 5.0, 14.0, 14.0]))
    return Vehicle(
        body=Body(
            matrix=diagonal,
            mass=jnp.array(55.0),
            cog=jnp.zeros(3),
            cob=jnp.array([0.0, 0.0, -0.1]),
            weight=jnp.array(539.6),
            buoyancy=jnp.array(539.6),
        ),
        added_mass=0.5 * diagonal,
        damping=Damping(linear=1.4 * diagonal, quadratic=diagonal),
        thrusters=Thrusters(
            position=jnp.array([[-0.5, -0.4, 0.0], [-0.5, 0.4, 0.0]]),
            direction=jnp.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
            max_thrust=jnp.array([100.0, 100.0]),
            deadband=jnp.zeros(2),
            lag=jnp.zeros(2),
            delay=jnp.zeros(2),
            saturation=jnp.ones(2),
            max_thrust_reverse=jnp.zeros(2),
            quadratic=jnp.zeros(2),
            advance_loss=jnp.zeros(2),
        ),
        density=jnp.array(1025.0),
        gravity=jnp.array(9.81),
        placed=(),
        name=name,
        dof=dof,
        thruster_names=("port", "starboard"),
    )


def predictions(dof: tuple[str, ...] = PLANAR, starts: int = 40) -> Predictions:
    """A craft on wide turns; before drifts off with the horizon's square, after hardly does."""
    rng = np.random.default_rng(0)
    ahead = np.linspace(-1.0, 5.0, 61)
    times = np.linspace(10.0, 280.0, starts)[:, None] + ahead
    locked = [i for i in range(18) if DOFS[i % 6] not in dof]
    noise = np.repeat([0.02, 0.01, 0.005, 0.005, 0.02, 0.02], 3)
    truth = np.zeros((*times.shape, 18))
    truth[..., 0], truth[..., 1] = 20 * np.sin(times / 20), 20 * np.cos(times / 20)
    truth[..., 2:5] = 0.1 * np.sin(times / 3.0)[..., None]
    truth[..., 5] = (times / 5.0) % (2 * np.pi) - np.pi
    truth[..., 6:12] = 0.6 + 0.3 * np.sin(times[..., None] / 7.0 + np.arange(6))
    truth[..., 12:] = 0.05 * np.cos(times[..., None] / 7.0 + np.arange(6))
    shape = np.where(ahead > 0, ahead, 0.0)[None, :, None] ** 2 * rng.normal(1.0, 0.3, (starts, 1, 18))
    measured = truth + rng.normal(0.0, 1.0, truth.shape) * noise
    measured[..., 12:] = np.nan  # no accelerations in this log
    measured[..., locked] = np.nan
    noise[12:] = np.nan
    noise[locked] = np.nan
    size = np.repeat([0.02, 0.01, 0.01, 0.008, 0.01, 0.01], 3)
    return Predictions(
        times=times,
        begin=10,
        measured=measured,
        before=truth + size * shape,
        after=truth + 0.05 * size * shape,
        noise=noise,
    )


def missing(size: float, dof: tuple[str, ...] = PLANAR, logs: int = 3) -> MissingWrench:
    """A wrench that begins at 120 s of the last log, with noise that each model leaves."""
    rng = np.random.default_rng(1)
    t = np.tile(np.arange(1.0, 300.0, 2.0), logs)
    log = np.repeat(np.arange(logs), t.size // logs)
    velocity = 0.8 * np.sin(t[:, None] / 9.0 + np.arange(6))
    acting = size * ((log == logs - 1) & (t > 120.0))
    wrench = 2.0 * rng.normal(size=velocity.shape) + acting[:, None] * np.sin(t / 13.0)[:, None]
    std = np.full_like(wrench, 2.0)
    for i, name in enumerate(DOFS):
        if name not in dof:
            wrench[:, i] = std[:, i] = np.nan
    return MissingWrench(log=log, t=t, wrench=wrench, std=std, velocity=velocity)


def checked() -> Check:
    """Surge and yaw are well excited, sway not at all."""
    seen = AxisCoverage("surge", 0.3, 0.4, (-0.2, 1.1), (-0.1, 1.0), (0.1, 0.0, 0.9), 0.1, (-0.3, 0.3))
    errors = {"surge": (0.0123, 0.02, 0.1, 0.3), "sway": (4.0, 2.0, 3.0, 9.0), "yaw": (0.1, 0.1, 0.2, 0.25)}
    axes = tuple(
        AxisCheck(dof, seen, inertia, linear, quadratic, damping, 1.0, True)
        for dof, (inertia, damping, linear, quadratic) in errors.items()
    )
    return Check(
        vehicle="catamaran",
        logs=TRAIN,
        duration=900.0,
        windows=225,
        window=4.0,
        axes=axes,
        coefficients=(),
        information=np.zeros(0),
        undetermined=(),
        misfit=1.0,
        advice=("Sway is not excited: drive sideways to either side.",),
    )


PORT = Finding(
    effect="thruster_gain",
    target="port",
    since=120.0,
    since_log="run3.csv",
    parameters={"factor": Parameter(0.7104, 0.0101, "1")},
    log_evidence=812.4,
    alternatives=(
        Alternative("inflow_loss", None, 810.9, True),
        Alternative("thrust_curve", None, 310.2, False),
    ),
)
CURRENT = Finding(
    effect="steady_current",
    target=None,
    since=None,
    since_log=None,
    parameters={
        "north": Parameter(-0.08, 0.003, "m/s"),
        "east": Parameter(0.11, 0.004, "m/s"),
    },
    log_evidence=96.1,
)
STRANGE = Finding("unknown", "yaw", None, None, {}, 41.0, signals=("r", "port", "t"), learned=True)

ROUND = (
    Weighed("thruster_gain:port", 812.4, 1650.0, {"factor": 0.71}),
    Weighed("inflow_loss", 810.9, 1646.0, {"per_speed": 0.3}),
    Weighed("thrust_curve", 310.2, 640.0, {"quadratic": 0.4}),
    *(Weighed(f"linear_damping:{dof}", 50.0 - i, 100.0, {"value": 9.0}) for i, dof in enumerate(DOFS)),
    Weighed("gyro_bias", float("nan"), 0.0, {"r": 0.0}),
    Weighed("deadband", -3.1, 0.1, {"width": 0.0}),
)
SECOND = (
    Weighed("steady_current", 96.1, 205.0, {"north": -0.08, "east": 0.11}),
    Weighed("constant_wrench:sway", 44.0, 95.0, {"value": 3.0}),
)


def diagnosis(**changes) -> Diagnosis:
    """A weak port thruster in a current, plausible in all its parts; `changes` replace some."""
    parts = {
        "verdict": "explained",
        "findings": (PORT, CURRENT),
        "gain": Gain(
            horizon=5.0,
            position=BeforeAfter(0.41, 0.03),
            velocity=BeforeAfter(0.11, 0.006),
            ratio=0.07,
            ratio_ci95=(0.06, 0.08),
            held_out=True,
            starts=40,
        ),
        "white": True,
        "depends_on": (),
        "vehicle": vehicle(),
        "extended": vehicle(),
        "recalibrated": (Recalibrated("linear_damping:surge", 77.0, 80.4, 1.2, "N s/m"),),
        "rounds": (
            ROUND,
            SECOND,
            (Weighed("waves", 0.4, 6.0, {"north": 0.1}),),
        ),
        "groups": (("thruster_gain:port", "inflow_loss"),),
        "misfit_before": 6.31,
        "misfit_after": 1.02,
        "predictions": predictions(),
        "missing_before": missing(25.0),
        "missing_after": missing(0.0),
        "catalogue": CATALOGUE,
        "check": checked(),
        "train": TRAIN,
        "tests": ("run4.csv",),
        "notes": ("Noise of the position was estimated from the logs.",),
    }
    return Diagnosis(**{**parts, **changes})


def nothing() -> Diagnosis:
    one = predictions()
    return diagnosis(
        verdict="nothing_found",
        findings=(),
        gain=Gain(5.0, None, None, 1.0, (1.0, 1.0), False, 40),
        recalibrated=(),
        rounds=((Weighed("waves", 0.4, 6.0, {}), Weighed("input_delay", 0.1, 1.0, {})),),
        groups=(),
        misfit_before=1.02,
        misfit_after=1.02,
        predictions=dataclasses.replace(one, before=one.after),
        missing_before=missing(0.0, logs=1),
        missing_after=missing(0.0, logs=1),
        train=("run1.csv",),
        tests=("run1.csv",),
        notes=(),
    )


def unexplained() -> Diagnosis:
    return diagnosis(
        verdict="partly_explained",
        findings=(CURRENT, STRANGE),
        white=False,
        depends_on=("r", "port", "t"),
        vehicle=vehicle(dof=DOFS),
        predictions=predictions(DOFS),
        missing_before=missing(25.0, DOFS),
        missing_after=missing(5.0, DOFS),
    )


class Reader(html.parser.HTMLParser):
    """The page as a reader sees it, and everything in it that could load something."""

    def __init__(self, content: str):
        super().__init__()
        self.words: list[str] = []
        self.scripts: list[str] = []
        self.links: list[str | None] = []
        self.silent = ""
        self.feed(content)
        self.text = re.sub(r"\s+", " ", "".join(self.words))

    def handle_starttag(self, tag, attrs):
        if tag in ("script", "style"):
            self.silent = tag
        if tag == "script":
            self.scripts.append(dict(attrs).get("type") or "")
        self.links += [value for key, value in attrs if key in ("href", "src", "action", "data")]

    def handle_endtag(self, tag):
        if tag == self.silent:
            self.silent = ""

    def handle_data(self, data):
        if not self.silent:
            self.words.append(data)


def read(content: Path) -> Reader:
    return Reader(content.read_text("utf-8"))


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> Path:
    return write_report(diagnosis(), tmp_path_factory.mktemp("report"))


@pytest.fixture
def quick_pictures(monkeypatch):
    """For tests of how files are written, not of what is drawn."""
    monkeypatch.setattr(_write, "pictures", lambda diagnosis: {"evidence.png": b"drawn"})


def test_the_page_says_what_is_wrong_and_what_to_do(report):
    text = read(report).text
    assert "2 causes explain these logs: thrust of port and steady current." in text
    assert "Thruster port gives 0.710 ± 0.010 times the thrust of the file, since t = 120 s of run" in text
    assert "The water moves 0.14 m/s towards 126° (north −0.080 ± 0.003 m/s, east 0.110 ± 0.004 m/s)." in text
    assert "Inspect the propeller and the motor named" in text
    assert "Very strong (log evidence 812; more than 5 is very strong)." in text
    assert "These logs cannot tell it from: thrust lost to the inflow." in text
    assert "A log with each thruster driven by itself (shows thrust of port); with the same" in text
    assert "the vehicle file is off by 2.5 times the sensor noise, the extended vehicle by no" in text
    assert "factor 0.71" in text and "north −0.08 m/s, east 0.11 m/s" in text
    assert "now have 7 % of the error that they had (95 % interval 6 % to 8 %)" in text
    assert "Held out: run4.csv was not used for" in text
    assert "0.41 m" in text and "0.03 m" in text
    assert "Noise of the position was estimated from the logs." in text


def test_the_page_says_how_many_were_refitted_and_that_noise_counts(report):
    text = read(report).text
    assert f"Round 1: {len(ROUND)} refitted, of which these 8 are shown" in text
    assert f"Round 2: {len(SECOND)} refitted Suspect" in text
    assert (
        f"3 rounds, each of which scores every suspect and refits the most promising: {len(ROUND) + 3}"
        in text
    )
    assert "over 5 s, held out; the log's own noise counts in it" in text


def test_a_title_has_few_digits_and_the_finding_below_all_of_them():
    fine = dataclasses.replace(PORT, parameters={"factor": Parameter(0.7194321, 0.0000062, "1")})
    one = diagnosis(findings=(fine,))
    assert _words.verdict(one).startswith("Thruster `port` gives 0.719 times the thrust of the file")
    assert "gives 0.719432 ± 0.000006 times" in Reader(_page.page(one)).text


def test_tables_that_are_wider_than_a_telephone_are_folded(report):
    content = report.read_text("utf-8")
    ranking = '<table class="ranking">'
    assert content.count("<table") == content.count('<table class="folded">') + content.count(ranking)
    for head in (
        "Before",
        "After",
        "Left",
        "Excited",
        "Velocities seen",
        "Inertia",
        "Damping force",
        "Linear",
    ):
        assert f'<td data-head="{head}">' in content


def test_the_page_says_what_the_logs_can_tell(report):
    text = read(report).text
    assert "Sway is not excited: drive sideways to either side." in text
    assert "surgeyes−0.2 ▁ █ 1.1 m/s1.2 %2 %10 %30 %" in text
    assert "swayno−0.2 ▁ █ 1.1 m/s> 100 %> 100 %> 100 %> 100 %" in text
    said = {
        axis["dof"]: axis for axis in json.loads((report.parent / "diagnosis.json").read_text())["excitation"]
    }
    assert said["yaw"]["relative_std"]["quadratic"] == 0.25
    assert said["surge"]["excited"] == "yes" and said["surge"]["velocity_range"] == [-0.2, 1.1]


def test_the_page_stands_alone(report):
    page = read(report)
    assert page.scripts == [""]
    assert [link for link in page.links if not (link or "").startswith("#")] == []
    content = report.read_text("utf-8")
    assert "default-src 'none'" in content
    assert "http://" not in content and "https://" not in content


def test_a_page_of_many_long_logs_stays_small():
    """Ten logs of twenty minutes at 10 Hz, six degrees of freedom, all sensors."""
    rng = np.random.default_rng(2)
    logs, knots, starts = 10, 2400, 60  # a knot every half second
    t = np.tile(0.5 * np.arange(knots), logs)
    wrench = rng.normal(size=(logs * knots, 6))
    velocity = rng.normal(size=wrench.shape)
    lost = MissingWrench(np.repeat(np.arange(logs), knots), t, wrench, np.ones_like(wrench), velocity)
    ahead = np.linspace(-4.0, 5.0, 91)
    times = np.linspace(10.0, 1190.0, starts)[:, None] + ahead
    channels = rng.normal(size=(*times.shape, 18))
    long = Predictions(times, 40, channels, channels + 0.1, channels - 0.1, np.ones(18), "test.csv")
    page = _page.page(
        diagnosis(
            vehicle=vehicle(dof=DOFS),
            predictions=long,
            missing_before=lost,
            missing_after=lost,
            train=tuple(f"{220 + i}.csv" for i in range(logs)),
        )
    )
    assert len(page.encode()) < 2_000_000
    shown = re.findall(r'data-figure="missing-9-5"[^>]*>(<svg.*?</svg>)', page, re.S)
    assert len(drawn(ElementTree.fromstring(shown[0]), "line before")) == 1


def test_curves_lie_where_their_numbers_do_and_break_where_there_are_none():
    plot = _svg.Plot("x", "y", from_zero=True)
    plot.line("before", np.array([0.0, 1.0, 2.0, 3.0, 4.0]), np.array([0.0, 1.0, np.nan, 3.0, 4.0]))
    plot.mark(2.0)
    svg = ElementTree.fromstring(plot.svg())
    (curve,) = drawn(svg, "line before")
    places = [tuple(map(float, place.split())) for place in re.split("[ML]", curve)[1:]]
    assert curve.count("M") == 2 and len(places) == 4
    (a, top), (b, second), (c, third), (d, last) = places
    assert np.allclose([b - a, d - c], (d - a) / 4, atol=0.11)
    assert np.allclose([top - second, third - last], (top - last) / 4, atol=0.11)
    assert drawn(svg, "mark")[0].startswith(f"M{(a + d) / 2:.1f} ")
    labels = {
        text.text: float(text.get("y", "nan")) for text in svg.iter("text") if text.get("class") == "end"
    }
    assert labels["0"] == pytest.approx(top + 4, abs=0.11) and labels["4"] == pytest.approx(
        last + 4, abs=0.11
    )


def test_page_and_print_draw_the_same_chart():
    """Each panel of the sheet that the page shows first, line by line and mark by mark."""
    one = diagnosis()
    for chart in (
        _figures.error_chart(one),
        _figures.missing_time_chart(one),
        _figures.trajectory_chart(one),
    ):
        assert chart is not None
        figure, panels = _pictures.printed(chart), chart.sheets[chart.chosen].panels
        assert len(figure.axes) == len(panels)
        for ax, panel in zip(figure.axes, panels, strict=True):
            plot = panel.figure
            svg = ElementTree.fromstring(plot.svg())
            lines = [shape for shape in plot.shapes if shape.form == "line"]
            bands = [shape for shape in plot.shapes if shape.form == "band"]
            curves = {str(line.get_label()): line for line in ax.get_lines()}
            assert ax.get_title() == panel.title and ax.get_xlabel() == plot.x_title
            for shape in lines:
                x, y = curves[shape.kind].get_data()
                assert np.array_equal(x, shape.x) and np.array_equal(y, shape.y, equal_nan=True)
                assert len(drawn(svg, f"line {shape.kind}")) == 1
            # The first panel has one more, empty, for the legend.
            filled = [one for one in ax.collections if one.get_paths()]
            assert len(filled) == len(bands) == sum(len(drawn(svg, f"band {b.kind}")) for b in bands)
            dotted = [line.get_xdata()[0] for line in ax.get_lines() if line.get_linestyle() == ":"]
            assert dotted == plot.marks and len(drawn(svg, "mark")) == len(plot.marks)
        words = [text.get_text() for text in figure.legends[0].get_texts()]
        named = [chart.band if name == "band" else name for name in chart.legend]
        assert words == [name for name in named if name != "since"]


WORSE = Gain(
    horizon=5.0,
    position=BeforeAfter(0.41, 0.03, (0.06, 0.08)),
    velocity=BeforeAfter(0.6, 1.1, (1.7, 1.95), worse=True),
    ratio=0.63,
    ratio_ci95=(0.5, 0.8),
    held_out=True,
    starts=40,
    channels={"x": BeforeAfter(0.41, 0.03, (0.06, 0.08)), "u": BeforeAfter(0.5, 1.0, (1.8, 2.2), worse=True)},
    per_log=(LogGain("run4.csv", 0.6, (0.4, 0.7), True, 30), LogGain("run5.csv", 0.9, None, True, 10)),
)


def test_what_got_worse_is_said_before_the_praise():
    one = diagnosis(gain=WORSE, tests=("run4.csv", "run5.csv"))
    (warning,) = one.warnings
    assert warning == (
        "Predicted worse than by the vehicle file on run4.csv and run5.csv, for certain: velocity 0.6 to 1.1 "
        "m/s (1.83 times, 95 %: 1.7 to 1.95), u 0.5 to 1 m/s (2 times, 95 %: 1.8 to 2.2)."
    )
    text = Reader(_page.page(one)).text
    assert text.index(warning) < text.index("Prediction error left63 %") < text.index("Finding 1 of 2")
    bought = text[text.index("4 What it bought Predicted worse") :]
    assert bought.index(warning) < bought.index("now have 63 % of the error")
    assert "That is not so for velocity and u." in bought
    assert "surge velocity u: worse0.5 m/s1 m/s200 %180 % to 220 %" in bought
    assert "Held out: run4.csv and run5.csv were not used" in bought
    assert "run4.csv3060 %40 % to 70 %" in bought and "run5.csv1090 %–" in bought
    said = one.to_json()["gain"]
    assert said["worse"] == ["velocity", "u"] and said["per_log"][1]["name"] == "run5.csv"
    assert said["per_channel"]["u"] == {"before": 0.5, "after": 1.0, "ratio": 2.0, "ratio_ci95": [1.8, 2.2]}
    assert not diagnosis().warnings


def test_what_was_found_and_dropped_is_told_with_its_reason():
    """No page says that nothing is named beside a suspect of great evidence without saying why it went."""
    gone = Dropped("waves", "It only stood in for a force that depends on signals and has no name.")
    strong = (Weighed("waves", 900.0, 1800.0, {"north": 3.0}),)
    one = dataclasses.replace(nothing(), rounds=(strong,), dropped=(gone,))
    text = Reader(_page.page(one)).text
    assert "No cause is named: what was found at first did not hold." in text
    assert "Named causesnonewhat was found at first did not hold" in text
    assert "waves dropped" in text and "What was taken here was dropped in the end" in text
    assert "Found and dropped waves: It only stood in for" in text
    assert one.to_json()["dropped"] == [{"label": "waves", "reason": gone.reason}]
    never = Reader(_page.page(dataclasses.replace(nothing(), rounds=(strong,)))).text
    assert "None of these was taken: what a cause explains must be more than chance" in never
    strange = Reader(_page.page(diagnosis(verdict="unexplained", findings=(STRANGE,)))).text
    assert "Named causesnonesomething unknown acts in yaw" in strange
    assert "How sureThat something acts there: very strong (log evidence 41" in strange


def test_times_are_since_the_start_of_a_log_beside_its_own_clock():
    one = diagnosis(
        clocks={"run3.csv": 2738655.1 - 12.3}, findings=(dataclasses.replace(PORT, since=2738655.1),)
    )
    assert "since 12.3 s (t = 2738655.1 s) of run3.csv" in Reader(_page.page(one)).text
    assert "since t = 120 s of run3.csv" in Reader(_page.page(diagnosis())).text


def test_all_files_are_there_and_nothing_else(report):
    written = {str(path.relative_to(report.parent)) for path in report.parent.rglob("*")}
    assert written == {
        "index.html",
        "diagnosis.json",
        "figures",
        "figures/error_vs_horizon.png",
        "figures/missing_wrench.png",
        "figures/evidence.png",
        "figures/trajectories.png",
    }
    for picture in (report.parent / "figures").iterdir():
        assert picture.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_the_json_is_what_the_diagnosis_says(report):
    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    text = (report.parent / "diagnosis.json").read_text()
    said = json.loads(text, parse_constant=refuse)
    assert said == json.loads(json.dumps(diagnosis().to_json()))
    assert said["findings"][0]["parameters"]["factor"]["value"] == 0.7104


def figures(page: Path) -> dict[str, ElementTree.Element]:
    """Each figure by its key."""
    content = page.read_text("utf-8")
    found = re.findall(r'data-figure="([^"]+)"[^>]*>(<svg.*?</svg>)', content, re.S)
    return {key: ElementTree.fromstring(svg) for key, svg in found}


def axis_titles(svg: ElementTree.Element) -> tuple[str, str]:
    across, up = list(svg.iter("text"))[-2:]
    return across.text or "", up.text or ""


def drawn(svg: ElementTree.Element, kind: str) -> list[str]:
    return [path.get("d", "") for path in svg.iter("path") if path.get("class") == kind]


def test_figures_hold_free_axes_and_measured_channels_only(report):
    shown = figures(report)
    titles = {axis_titles(shown[f"missing-2-{i}"])[1] for i in (0, 1, 5)}
    assert titles == {"X [N]", "Y [N]", "N [N m]"}
    assert "missing-2-2" not in shown  # heave is locked
    assert "trajectory-psi-0" in shown and "trajectory-du-0" not in shown
    errors = [figure for key, figure in shown.items() if key.startswith("error-")]
    units = [axis_titles(figure)[1] for figure in errors]
    assert units == [f"rms error [{unit}]" for unit in ("m", "°", "m/s", "°/s")]
    # The beginning of the finding is marked in its own log and in no other.
    assert len(drawn(shown["missing-2-0"], "mark")) == 1
    assert not drawn(shown["missing-0-0"], "mark")


def test_nothing_found_says_what_was_checked(tmp_path):
    text = read(write_report(nothing(), tmp_path)).text
    assert "Nothing is wrong that these logs could show" in text
    assert "Over 1 training log, the vehicle file is off by no more than the sensor noise. What" in text
    assert "These were checked: delay of the commands and waves." in text
    assert "Not held out: run1.csv was also used for training" in text
    assert "not measured" in text
    said = json.loads((tmp_path / "diagnosis.json").read_text())
    assert said["findings"] == [] and said["gain"]["position_rmse_m"] is None


def test_an_unknown_cause_names_axis_signals_and_learned_term():
    text = Reader(_page.page(unexplained())).text
    assert "Steady current explains a part of what these logs show; something that" in text
    assert "A moment in yaw acts on the vehicle that no known cause explains." in text
    assert "Look for what changes with the yaw rate r, command of port and time t." in text
    assert "carries a term learned from the log" in text
    lost = dataclasses.replace(STRANGE, learned=False)
    text = Reader(_page.page(dataclasses.replace(unexplained(), findings=(CURRENT, lost)))).text
    assert "It was not learned" in text and "carries a term" not in text


def test_a_file_that_was_refitted_is_not_called_right():
    shown = dataclasses.replace(nothing(), recalibrated=diagnosis().recalibrated, misfit_before=9.0)
    text = Reader(_page.page(shown)).text
    assert "No single cause is to blame: the extended vehicle has 1 refitted coefficient of the file." in text
    assert "the vehicle file is off by 3 times the sensor noise, the extended vehicle by no more" in text
    assert "Nothing is wrong" not in text and "Nothing to mend" not in text


def test_a_vehicle_without_predictions_or_wrench_still_has_a_page(tmp_path):
    none = np.zeros((0, 61, 18))
    empty = Predictions(np.zeros((0, 61)), 10, none, none, none, np.full(18, np.nan))
    lost = MissingWrench(np.zeros(0, int), np.zeros(0), *(np.zeros((0, 6)) for _ in range(3)))
    bare = diagnosis(predictions=empty, missing_before=lost, missing_after=lost, rounds=(), groups=())
    page = write_report(bare, tmp_path)
    assert "There are no predictions to show." in read(page).text
    assert figures(page) == {}
    assert list((tmp_path / "figures").iterdir()) == []


def test_what_cannot_be_drawn_is_dropped(tmp_path):
    wild = predictions()
    wild.before[3, 30:, :] = np.inf
    lost = missing(25.0)
    lost.wrench[5] = np.inf
    lost.std[7] = np.nan
    page = write_report(diagnosis(predictions=wild, missing_before=lost), tmp_path)
    errors = _curves.errors_by_horizon(wild)
    assert all(np.isfinite(group.errors["before"]).all() for group in errors)
    content = page.read_text("utf-8")
    assert not re.search(r' d="[^"]*(nan|inf)', content)


def test_what_cannot_be_told_apart_comes_with_the_plan_that_would(tmp_path):
    text = read(write_report(diagnosis(), tmp_path)).text
    plan = text[text.index("jaxmarine plan --vehicle VEHICLE") :]
    assert plan.index('--cause "thruster_gain:port factor=') < plan.index('--cause "inflow_loss')


def test_names_from_files_stay_text(tmp_path):
    # In the pictures a dollar sign would begin a formula, and the font lacks most scripts.
    target = f"{EVIL} $x_{{$ 漢"
    evil = dataclasses.replace(PORT, target=target, since_log=EVIL, alternatives=())
    page = write_report(
        diagnosis(
            vehicle=vehicle(EVIL),
            findings=(evil,),
            rounds=((Weighed(f"thruster_gain:{target}", 9.0, 9.0, {}),),),
            groups=((f"thruster_gain:{target}", "waves"),),
            train=("a.csv", EVIL, "$b_{.csv"),
            tests=(EVIL,),
            notes=(EVIL, "an odd ` backtick"),
        ),
        tmp_path,
    )
    content = page.read_text("utf-8")
    assert EVIL not in content
    assert "<script>alert" not in content
    assert f"Diagnosis of {EVIL}" in read(page).text
    assert read(page).scripts == [""]


def test_a_number_that_json_lacks_is_refused_and_leaves_nothing(tmp_path):
    lost = dataclasses.replace(PORT, log_evidence=float("nan"))
    with pytest.raises(ValueError, match="JSON"):
        write_report(diagnosis(findings=(lost,)), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("quick_pictures")
def test_a_folder_that_cannot_be_made_is_an_input_error(tmp_path):
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(InputError, match="taken"):
        write_report(nothing(), tmp_path / "taken")


@pytest.mark.usefixtures("quick_pictures")
def test_a_disk_that_fills_up_leaves_the_report_that_was_there(tmp_path, monkeypatch):
    page = write_report(nothing(), tmp_path)
    there = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
    write = Path.write_bytes

    def full(path, content):
        if path.name.endswith("evidence.png"):
            raise OSError(28, "No space left on device")
        return write(path, content)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(InputError, match="no space left"):
        write_report(diagnosis(), page.parent)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == there


@pytest.mark.usefixtures("quick_pictures")
def test_a_second_report_replaces_the_first_and_spares_other_files(tmp_path):
    (tmp_path / "extended.toml").write_text("schema = 1")
    write_report(diagnosis(), tmp_path)
    page = write_report(nothing(), tmp_path)
    assert "Nothing is wrong" in read(page).text
    assert (tmp_path / "extended.toml").read_text() == "schema = 1"
    assert not [path for path in tmp_path.rglob(".*")]


SENTENCES = {
    "waves": (
        None,
        {"north": 3.0, "east": 4.0, "period": 6.0, "phase": 0.1},
        "up to 5 N along 53°/233°",
    ),
    "tether_drag": (None, {"coefficient": 12.0}, "drags with 12 N at 1 m/s"),
    "added_mass": (
        "surge",
        {"value": 10.0},
        "10.0 ± 0.2 kg more added mass in surge than the file says (file 27.5, now 37.5)",
    ),
    "payload": (
        None,
        {"mass": 3.0, "volume": 0.001, "x": 0.5, "y": -0.2, "z": 0.1},
        "0.5 ± 0.2 m ahead of, 0.2 ± 0.2 m to port of and",
    ),
    "buoyancy": (
        None,
        {"force": -9.81},
        "9.8 ± 0.2 N less buoyancy than the file says: in water it is 1 kg heavier",
    ),
    "trim": (None, {"x": -0.5, "z": 0.3}, "0.5 ± 0.2 m further aft and 0.3 ± 0.2 m lower"),
    "linear_damping": ("yaw", {"value": -2.0}, "2.0 ± 0.2 N m s less linear damping in yaw"),
    "quadratic_damping": ("sway", {"value": 2.0}, "more quadratic damping in sway"),
    "coupled_damping": ("sway<-yaw", {"value": 2.0}, "motion in yaw causes a force in sway"),
    "coupled_added_mass": ("sway+yaw", {"value": -2.0}, "2.0 ± 0.2 kg m less added mass between them"),
    "hull_lift": (None, {"Y_uv": 20.0, "N_uv": 3.0}, "Y_uv 20.0 ± 0.2 N s²/m²"),
    "turning_lift": (None, {"Y_ur": 20.0, "N_ur": 3.0}, "in turns at speed the hull feels a lift"),
    "fluid_memory": (
        "heave",
        {"gain": 9.0, "time_constant": 2.0},
        "comes late: 9.0 ± 0.2 N s/m, building up over 2.0 ± 0.2 s",
    ),
    "constant_wrench": (
        "yaw",
        {"value": -4.0},
        "constant moment of 4.0 ± 0.2 N m in yaw turns the bow to port",
    ),
    "thruster_gain": (
        "all",
        {"factor": 0.02},
        "0.0 ± 0.2 times the thrust of the file: commands are practically not acted on",
    ),
    "reverse_thrust": (
        "port",
        {"factor": 0.7},
        "at negative commands thruster `port` gives 0.7 ± 0.2 times the thrust of the file",
    ),
    "thrust_curve": (
        None,
        {"quadratic": 1.0},
        "at half command there is 50 % of the file's thrust",
    ),
    "thruster_lag": (None, {"time_constant": 0.4}, "a lag of 0.4 ± 0.2 s"),
    "input_delay": (None, {"delay": 0.3}, "0.3 ± 0.2 s late"),
    "deadband": (None, {"width": 0.2}, "smaller than 20 ± 20 % of full command do nothing"),
    "saturation": (None, {"limit": 0.7}, "beyond 70 ± 20 % of full command"),
    "inflow_loss": (None, {"per_speed": 0.2}, "lose 20 ± 20 % of their thrust per m/s"),
    "velocity_lever_arm": (
        None,
        {"x": 1.0},
        "that of a point 1.0 ± 0.2 m ahead of the body origin",
    ),
    "velocity_scale": (None, {"factor": 1.2}, "1.2 ± 0.2 times the true one: 20 % too large"),
    "velocity_misalignment": (
        None,
        {"yaw": -0.5236},
        "turned by 30 ± 11° to port: the velocity sensor sits turned by as much to starboard",
    ),
    "velocity_in_earth_axes": (
        None,
        {"fraction": 1.0},
        "in earth axes (north, east, down) instead of body axes",
    ),
    "compass_deviation": (
        None,
        {"constant": 0.0, "cos": 0.5236, "sin": 0.0},
        "0 ± 11° + 30 ± 11° cos(psi) + 0 ± 11° sin(psi)",
    ),
    "sensor_delay": ("velocity", {"delay": 0.3}, "the logged velocity comes"),
    "exchanged_thrusters": ("port+star", {}, "each holds the other's command"),
    "gyro_bias": (None, {"r": 0.5236}, "plus a constant (r 30 ± 11 °/s)"),
    "steady_current": (None, {"north": 0.0, "east": -1.0}, "1 m/s towards 270°"),
    "wind_push": (None, {"north": 0.0, "east": -3.0}, "3 N, as of the wind, pushes towards 270°"),
    "surface_gain": ("rudder", {"factor": -0.5}, "it acts the wrong way"),
    "surface_offset": ("rudder", {"angle": 0.5236}, "stands 30 ± 11° beside its command"),
    "surface_stuck": ("rudder", {"angle": -0.5236}, "stuck at −30 ± 11°"),
    "surface_lag": (None, {"time_constant": 0.5}, "follow their commands with"),
    "surface_rate": (None, {"limit": 0.5236}, "no faster than 30 ± 11°/s"),
    "wake": ("prop", {"fraction": 0.1}, "the wake fraction of `prop`"),
    "cross_flow_drag": (None, {"coefficient": 0.5}, "across the flow is that of the file plus"),
    "voltage": (None, {"exponent": 1.0}, "at nine tenths of it there is 90 % as much"),
    "wind": (None, {"surge": -0.1, "sway": 0.2}, "the wind pushes otherwise"),
    "unknown": ("roll", {}, "moment in roll acts on the vehicle that no known cause explains"),
}


def found(name: str, target: str | None, values: dict[str, float]) -> Finding:
    units = {effect.name: effect.units for effect in CATALOGUE}.get(name, {})
    parameters = {key: Parameter(value, 0.2, units[key]) for key, value in values.items()}
    return Finding(name, target, None, None, parameters, 10.0)


@pytest.mark.parametrize("name", SENTENCES)
def test_each_effect_has_its_sentence(name):
    target, values, expected = SENTENCES[name]
    said = _causes.what(found(name, target, values), vehicle())
    assert expected.lower() in said.lower()
    assert said[0].isupper() and said.endswith(".")


def test_the_whole_catalogue_is_told():
    assert {effect.name for effect in CATALOGUE} | {"unknown"} == set(SENTENCES)
    for effect in CATALOGUE:
        assert _words.advice(found(effect.name, None, {})) != ""


def test_an_effect_of_the_users_own_is_told_by_its_name():
    own = Finding("sail_force", None, None, None, {"area": Parameter(2.0, 0.2, "m²")}, 3.0)
    assert _causes.what(own, vehicle()) == "Sail force (area 2.0 ± 0.2 m²)."
    assert _words.advice(own) == ""

    class SailForce(Waves):
        """An effect that the catalogue does not know."""

        name = "sail_force"
        titled = "force of the sail"
        advice = "reef the sail"

        @classmethod
        def said(cls, found, craft) -> str:
            return (
                f"the sail pulls with {found.parameters['area'].value:g} m² at {float(craft.density):g} kg/m³"
            )

    catalogue = (*CATALOGUE, SailForce)
    assert (
        _causes.what(own, vehicle(), catalogue=catalogue)
        == f"The sail pulls with 2 m² at {vehicle().density:g} kg/m³."
    )
    assert [_causes.title(label, catalogue) for label in ("sail_force", "sail_force:main")] == [
        "force of the sail",
        "force of the sail in main",
    ]
    assert _words.advice(own, catalogue) == "Reef the sail."
    # Also one that was only weighed.
    assert _words.values("sail_force", {"period": 2.0}, catalogue) == "period 2 s"


def test_numbers_keep_the_digits_that_their_error_leaves():
    assert _numbers.plus_minus(0.71044, 0.0041) == "0.710 ± 0.004"
    assert _numbers.plus_minus(-1234.5, 15.0, "N") == "−1234 ± 15 N"
    assert _numbers.plus_minus(2.0, float("nan"), "N") == "2 N"
    assert _numbers.number(-0.00001234) == "−1.23·10⁻⁵"
    assert _numbers.number(float("inf")) == "∞"


def test_errors_go_the_short_way_round_and_meet_a_hand_made_rms():
    one = predictions()
    one.measured[..., 5], one.before[..., 5] = np.pi - 0.05, -np.pi + 0.05
    attitude = next(g for g in _curves.errors_by_horizon(one) if g.title == "Attitude")
    assert np.allclose(attitude.errors["before"], np.rad2deg(0.1))
    position = _curves.errors_by_horizon(one)[0]
    last = one.before[:, -1, :2] - one.measured[:, -1, :2]
    assert np.isclose(position.errors["before"][-1], np.sqrt(np.mean(last**2)))
    assert position.horizon[0] == 0.0 and np.isclose(position.horizon[-1], 5.0)


def test_courses_have_no_jumps_in_heading():
    one = predictions()
    psi = CHANNELS.index("psi")
    for start in range(len(one.times)):
        c = _curves.course(one, start)
        for curve in c.curves.values():
            assert np.abs(np.diff(curve[:, psi])).max() < 20.0  # [°]
        assert np.abs((c.curves["measured"] - c.curves["before"])[:11, psi]).max() < 5.0


def test_typical_starts_lie_around_the_median_error():
    one = predictions()
    one.before[7] += 100.0
    starts = _curves.typical_starts(one)
    assert len(starts) == 3 and 7 not in starts and list(starts) == sorted(starts)


def test_what_is_far_from_the_noise_is_no_clean_answer():
    """Ten times the noise: a wrong axis or sign is likelier than what was named, or than nothing."""
    far = {"misfit_after": 101.0, "white": False}
    assert "leaves much" in _words.verdict(diagnosis(**far))
    assert "leaves much" in _words.verdict(diagnosis(findings=(PORT,), **far))
    nothing = diagnosis(verdict="nothing_found", findings=(), recalibrated=(), **far)
    assert "no cause was found" in _words.verdict(nothing) and "signs" in _words.verdict(nothing)
    assert "no cause was found" not in _words.verdict(dataclasses.replace(nothing, misfit_after=99.0))
    contradicted = diagnosis(contradicted="r contradict what positions show.")
    assert _words.explanation(contradicted).endswith("r contradict what positions show.")


def test_a_page_does_not_call_noise_what_the_model_misses():
    missed = diagnosis(missed=True, white=False, verdict="nothing_found", findings=(), recalibrated=())
    text, far = (
        Reader(_page.page(missed)).text,
        "the vehicle file misses the sensors by far more than their noise",
    )
    assert f"No cause was found, but {far}." in text
    assert f"{far}; the notes say by how much" in text
    assert "1 is what sensors are weighed by" in text and "no more than the sensor noise" not in text
    partly = diagnosis(missed=True, white=False)
    assert "the extended vehicle misses the sensors by far more" in _words.explanation(partly)


def test_a_gain_without_an_interval_says_why():
    gain = dataclasses.replace(diagnosis().gain, ratio_ci95=None)
    assert "too short a log for an interval" in _words.gain_words(diagnosis(gain=gain))
    assert diagnosis(gain=gain).to_json()["gain"]["ratio_ci95"] is None


def test_the_page_tells_the_noise_that_was_used():
    text = Reader(_page.page(diagnosis())).text
    assert "position 0.02 m (estimated), attitude 0.01 rad (estimated), velocity 0.005 m/s" in text
    stated = dataclasses.replace(vehicle(), sensors=(("position", 0.02),))
    assert (
        "position 0.02 m (stated), attitude 0.01 rad (estimated)"
        in Reader(_page.page(diagnosis(vehicle=stated))).text
    )


def test_the_error_of_a_slow_sensor_is_a_line_over_the_steps_without_samples():
    """Positions in every other row only: what stands at the others is what the line between them gives."""
    slow = predictions()
    measured = slow.measured.copy()
    measured[:, slow.begin + 1 :: 2, :3] = np.nan
    whole = {one.title: one for one in _curves.errors_by_horizon(slow)}
    sparse = {
        one.title: one for one in _curves.errors_by_horizon(dataclasses.replace(slow, measured=measured))
    }
    title = "Position"
    for model in ("before", "after"):
        kept, full = sparse[title].errors[model], whole[title].errors[model]
        np.testing.assert_allclose(kept[::2], full[::2])
        np.testing.assert_allclose(kept[1:-1:2], (full[:-2:2] + full[2::2])[: len(kept[1:-1:2])] / 2)

"""The report is one valid, self-contained page that holds every section and figure, for good and for odd results."""

import base64
import dataclasses
import html
import json
import re
import subprocess
import threading
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.signal
from click.testing import CliRunner
from synthetic_calibration import APRIL_GRID, make_calibration, make_cross_validation, make_images

from jaxcal.cameras import PinholeRadtan
from jaxcal.cli import main
from jaxcal.errors import CalibrationError
from jaxcal.observations import Frames
from jaxcal.results import Calibration, judge, write_report
from jaxcal.results.report.camera_figures import frame_rms
from jaxcal.results.report.drawing import label, panel, to_svg
from jaxcal.results.report.frames import frame_pictures
from jaxcal.results.report.imu_figures import _envelope
from jaxcal.results.report.lens_figure import _looked, lens_picture
from jaxcal.results.report.rig_figures import rig_pictures, rig_poses
from jaxcal.results.report.rig_scene import look, rig_scene
from jaxcal.results.report.time_figure import time_picture
from jaxcal.results.whiteness import autocorrelation

VOID = {"meta", "link", "br", "hr", "img", "input"}
CAMERA_FIGURES, IMU_FIGURES = 8, 10


class Page(HTMLParser):
    """The page as a list of elements with the section they are in; nesting is checked on the way."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.section: str | None = None
        self.elements: list[tuple[str, dict[str, str | None], str | None]] = []
        self.texts: list[tuple[str, str]] = []
        self.feed(text)
        self.close()
        assert self.stack == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = dict(attrs)
        if tag == "section":
            self.section = attributes["id"]
        self.elements.append((tag, attributes, self.section))
        if tag not in VOID:
            self.stack.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs), self.section))

    def handle_endtag(self, tag: str) -> None:
        assert self.stack.pop() == tag
        if tag == "section":
            self.section = None

    def handle_data(self, data: str) -> None:
        if data.strip() and self.stack:
            self.texts.append((self.stack[-1], data.strip()))

    def figures(self, section: str, kind: str = "plot") -> int:
        return sum(
            tag == "figure" and where == section and attributes.get("class") == kind
            for tag, attributes, where in self.elements
        )

    @property
    def sections(self) -> list[str]:
        return [attributes["id"] or "" for tag, attributes, _ in self.elements if tag == "section"]


def assert_sound(text: str) -> Page:
    """Nested well, ids unique, every reference inside the page, no colour left that the page does not define."""
    page = Page(text)
    ids = [attributes["id"] for _, attributes, _ in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    for tag, attributes, _ in page.elements:
        assert tag not in ("link", "iframe", "object")
        assert tag != "script" or attributes == {}  # its text stands in the page
        for name in ("href", "src", "xlink:href", "srcset", "action"):
            value = attributes.get(name)
            if value is not None:
                assert value.startswith(("#", "data:")), value[:80]
                if value.startswith("#"):
                    assert value[1:] in ids
    for reference in re.findall(r"url\(([^)]*)\)", text):
        assert reference.startswith("#")
        assert reference[1:] in ids
    assert "@import" not in text
    assert not re.search(r"#0[0-9a]0[0-9a]0[0-9a]\b", text)
    for variable in set(re.findall(r"var\((--[a-z-]+)\)", text)):
        assert re.search(rf"{variable}\s*:", text), variable
    return page


def report(calibration: Calibration, folder: Path, images: Any = None, **more: Any) -> tuple[Page, str]:
    path = folder / "report.html"
    write_report(calibration, path, images, **more)
    text = path.read_text()
    return assert_sound(text), text


@pytest.fixture(scope="module")
def pair() -> Calibration:
    return make_calibration(2, True, frames=30)


@pytest.fixture(scope="module")
def pair_report(pair: Calibration, tmp_path_factory: pytest.TempPathFactory) -> tuple[Page, str]:
    return report(pair, tmp_path_factory.mktemp("pair"), make_images(pair))


@pytest.fixture(scope="module")
def eight_report(tmp_path_factory: pytest.TempPathFactory) -> tuple[Page, str]:
    return report(make_calibration(8, False, frames=12), tmp_path_factory.mktemp("eight"))


def test_every_section_and_figure_is_there(pair_report: tuple[Page, str]) -> None:
    page, _ = pair_report
    assert page.sections == ["verdict", "parameters", "rig", "camera-0", "camera-1", "imu", "solution"]
    for camera in ("camera-0", "camera-1"):
        assert page.figures(camera) == CAMERA_FIGURES
        assert page.figures(camera, "frame") == 6
    assert page.figures("rig") == 4  # in three dimensions, from above, the path, the time offsets
    assert page.figures("imu") == IMU_FIGURES
    assert page.figures("solution") == 1


def test_every_figure_says_what_is_good_and_what_to_do_otherwise(pair_report: tuple[Page, str]) -> None:
    page, text = pair_report
    plots = sum(page.figures(section) for section in page.sections)
    captions = re.findall(r"<figcaption>\s*<h4>(.*?)</h4>(.*?)</figcaption>", text, re.DOTALL)
    assert len(captions) == plots
    for title, body in captions:
        assert title
        assert re.search(r"<b>Good:</b> \S.*<b>If not:</b> \S", body, re.DOTALL), title


def test_the_page_shows_the_numbers(pair: Calibration, pair_report: tuple[Page, str]) -> None:
    page, text = pair_report
    cells = [data for tag, data in page.texts if tag == "td"]
    for camera in pair.cameras:
        assert f"{float(camera.model.intrinsics[0]):.2f}" in cells  # two digits of sigma: 0.21
        assert f"{camera.reprojection_rms_px:.3f} px" in text
        assert camera.timeshift_cam_imu is not None
        assert f"{camera.timeshift_cam_imu * 1e3:.4f}" in cells
    assert "0.21" in cells
    assert "pinhole-radtan" in text
    assert "knots_per_second" in text


def test_corners_are_drawn_where_they_were_found(pair: Calibration, pair_report: tuple[Page, str]) -> None:
    page, _ = pair_report
    drawn = {
        (float(attributes["cx"] or "nan"), float(attributes["cy"] or "nan"))
        for tag, attributes, section in page.elements
        if tag == "circle" and section == "camera-0"
    }
    camera = pair.cameras[0]
    found = {(round(float(u), 1), round(float(v), 1)) for u, v in camera.detections.pixels}
    assert drawn
    assert drawn <= found


def test_a_light_and_a_dark_page_and_paper(pair_report: tuple[Page, str]) -> None:
    _, text = pair_report
    assert "prefers-color-scheme: dark" in text
    assert "@media print" in text
    assert 'name="viewport"' in text
    assert "var(--ink)" in text[text.index("<svg") :]


def test_a_saved_calibration_gives_the_same_page(tmp_path: Path) -> None:
    made = make_calibration(1, False, frames=10)
    made.save(tmp_path)
    done = CliRunner().invoke(main, ["report", str(tmp_path), "--out", str(tmp_path / "again.html")])
    assert done.exit_code == 0
    assert done.output.startswith(judge(made).headline)
    assert (tmp_path / "again.html").read_text() == report(made, tmp_path)[1]


def test_eight_cameras_without_imu_nor_images(eight_report: tuple[Page, str]) -> None:
    page, text = eight_report
    assert page.sections == ["verdict", "parameters", "rig", *(f"camera-{k}" for k in range(8)), "solution"]
    assert all(page.figures(f"camera-{k}") == CAMERA_FIGURES for k in range(8))
    assert page.figures("rig") == 2
    assert "frame" not in {attributes.get("class") for _, attributes, _ in page.elements}
    assert "gravity" not in text.lower()
    assert len(text) < 8e6


def test_drawing_a_rig_gives_matplotlib_nothing_to_complain_of(caplog: pytest.LogCaptureFixture) -> None:
    for cameras in (1, 2, 5):
        rig_pictures(make_calibration(cameras, True, frames=4), "rig")
    assert caplog.records == []


def test_one_camera_that_contributed_nothing(tmp_path: Path) -> None:
    page, text = report(make_calibration(1, False, frames=6, unused=1.0), tmp_path)
    assert page.sections == ["verdict", "parameters", "camera-0", "solution"]
    assert page.figures("camera-0") == CAMERA_FIGURES
    assert "Do not use" in text


def test_a_camera_that_saw_nothing_at_all(tmp_path: Path) -> None:
    made = make_calibration(1, False, frames=6)
    empty = dataclasses.replace(
        made.cameras[0],
        detections=dataclasses.replace(
            made.cameras[0].detections, frame=np.zeros(0, int), point=np.zeros(0, int), pixels=np.zeros((0, 2))
        ),
        residuals_px=np.zeros((0, 2)),
        inlier=np.zeros(0, bool),
        corner_sigma_px=float("nan"),
    )
    _, text = report(dataclasses.replace(made, cameras=(empty,)), tmp_path)
    assert "Do not use" in text


def test_an_imu_without_bounds_on_its_biases_and_with_gaps(tmp_path: Path) -> None:
    made = make_calibration(1, True, frames=10)
    assert made.imu is not None
    gyro = made.imu.gyro_predicted.copy()
    gyro[:50] = np.nan
    imu = dataclasses.replace(made.imu, gyro_bias_std=None, accel_bias_std=None, gyro_predicted=gyro)
    page, text = report(dataclasses.replace(made, imu=imu, convergence=np.zeros(0)), tmp_path)
    assert page.figures("imu") == IMU_FIGURES
    assert "Bands:" not in text
    assert "No cost was recorded" in text


def test_what_users_wrote_cannot_break_the_page(tmp_path: Path) -> None:
    made = make_calibration(1, False, frames=6)
    camera = dataclasses.replace(made.cameras[0], name='<script src="http://x">&')
    odd = dataclasses.replace(
        made, cameras=(camera,), warnings=("<b>weak & odd",), settings={"<i>": '"><img src=http://y>'}, blocks=(),
        covariance=np.zeros((0, 0)),
    )  # fmt: skip
    _, text = report(odd, tmp_path)
    assert "&lt;b&gt;weak &amp; odd" in text


def test_progress_is_told_camera_by_camera(tmp_path: Path) -> None:
    told: list[tuple[str, int, int]] = []
    made = make_calibration(2, False, frames=6)
    write_report(made, tmp_path / "r.html", progress=lambda *args: told.append(args))
    assert told == [("report", k, 3) for k in range(4)]


def test_two_reports_at_once_do_not_disturb_each_other(tmp_path: Path) -> None:
    made = make_calibration(1, False, frames=6)
    alone = report(made, tmp_path)[1]
    threads = [threading.Thread(target=write_report, args=(made, tmp_path / f"{k}.html")) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [(tmp_path / f"{k}.html").read_text() for k in range(2)] == [alone, alone]


# --- in a browser ----------------------------------------------------------------------------------------------------


@pytest.mark.browser
def test_a_browser_draws_every_figure_and_turns_the_rig(
    pair_report: tuple[Page, str], eight_report: tuple[Page, str], chromium: str, tmp_path: Path
) -> None:
    one, other = (make_calibration(1, False, seed, frames=10) for seed in (0, 1))
    one_report = report(one, tmp_path, cross_validation=make_cross_validation(one, other))
    pages = {"pair": pair_report, "eight": eight_report, "one": one_report}
    for name, (_, text) in pages.items():
        catch = "<script>var errors = []; window.onerror = (message) => { errors.push(message); };</script>"
        (tmp_path / f"{name}.html").write_text(text.replace("<head>", f"<head>{catch}", 1))
    frames = [(name, width) for name in pages for width in (1280, 390)]
    script = (Path(__file__).parent / "pages_in_browser.js").read_text()
    inner = "".join(
        f'<iframe name="{name} {width}" src="{name}.html" width="{width}" height="800"></iframe>'
        for name, width in frames
    )
    (tmp_path / "all.html").write_text(f"<!DOCTYPE html><html><body>{inner}<script>{script}</script></body></html>")
    arguments = ["--headless=new", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files", "--dump-dom"]
    arguments += [f"--user-data-dir={tmp_path / 'profile'}", (tmp_path / "all.html").as_uri()]
    done = subprocess.run([chromium, *arguments], check=True, capture_output=True, text=True, timeout=120)
    found = re.search(r'<pre id="seen">(.*?)</pre>', done.stdout, re.DOTALL)
    assert found, done.stderr
    seen = {entry["name"]: entry for entry in json.loads(html.unescape(found[1]))}
    assert set(seen) == {f"{name} {width}" for name, width in frames}
    for name, entry in seen.items():
        assert entry["errors"] == [], name
        page = pages[name.split()[0]][0]
        assert entry["plots"] == sum(page.figures(section) for section in page.sections)
        assert entry["empty"] == []
        assert entry["small"] == 0
        assert entry["overflow"] <= 0, name
        scene = entry["scene"]
        assert (scene is None) == (name.split()[0] == "one")  # a camera alone has no rig to turn
        if scene is None:
            continue
        assert scene["turned"] != scene["before"]
        assert scene["released"] == scene["turned"]
        assert scene["keyed"] != scene["turned"]
        # What the page was written with is what its script draws from the same view.
        back, before = (np.array(re.findall(r"[-\d.]+", scene[key]), float) for key in ("back", "before"))
        np.testing.assert_allclose(back, before, atol=0.21)


# --- pictures of frames ----------------------------------------------------------------------------------------------


def test_the_worst_frame_is_among_those_shown() -> None:
    made = make_calibration(1, False, frames=40, target=APRIL_GRID)
    camera = made.cameras[0]
    residuals = camera.residuals_px.copy()
    residuals[camera.detections.frame == 17] *= 5.0
    camera = dataclasses.replace(camera, residuals_px=residuals)
    frames, rms = frame_rms(camera)
    assert frames[np.argmax(rms)] == 17
    shown = frame_pictures(camera, make_images(made)["cam0"])
    assert len(shown) == 6
    assert [picture.caption.startswith("Worst frame") for picture in shown].count(True) == 1


def test_images_are_found_by_their_time() -> None:
    made = make_calibration(1, False, frames=12)
    camera = made.cameras[0]
    # A picture holds its frame's number as its grey level.
    images = [np.full((480, 640), 20 * k, np.uint8) for k in range(12)]
    kept = [2, 3, 7, 11]
    frames = Frames(camera.detections.timestamps_ns[kept], [images[k] for k in kept], (640, 480))
    shown = frame_pictures(camera, frames)
    grey = []
    for picture in shown:
        data = np.frombuffer(base64.b64decode(picture.jpeg_base64), np.uint8)
        grey.append(int(np.median(np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)))))
    np.testing.assert_allclose(grey, [20 * k for k in kept], atol=2)


def test_images_of_another_camera_are_refused() -> None:
    made = make_calibration(1, False, frames=6)
    times = made.cameras[0].detections.timestamps_ns
    frames = Frames(times, [np.zeros((100, 100), np.uint8)] * len(times), (100, 100))
    with pytest.raises(CalibrationError, match="480 x 640"):
        frame_pictures(made.cameras[0], frames)


# --- parts of figures ------------------------------------------------------------------------------------------------


def test_the_error_of_a_frame_is_that_of_its_used_corners() -> None:
    camera = make_calibration(1, False, frames=10, unused=0.1, rejected=0.1).cameras[0]
    frames, rms = frame_rms(camera)
    for frame, value in zip(frames, rms, strict=True):
        mine = (camera.detections.frame == frame) & camera.inlier & np.isfinite(camera.residuals_px[:, 0])
        assert value == pytest.approx(np.sqrt(np.mean(np.sum(camera.residuals_px[mine] ** 2, axis=1))))


def test_a_thinned_line_keeps_its_extremes() -> None:
    random = np.random.default_rng(0)
    t, values = np.arange(20_000) * 1e-3, random.normal(size=20_000)
    thin_t, thin = _envelope(t, values)
    assert len(thin) <= 1000
    assert (thin.min(), thin.max()) == (values.min(), values.max())
    assert np.all(np.diff(thin_t) >= 0)
    assert abs(thin_t[np.argmax(thin)] - t[np.argmax(values)]) < 0.05


@pytest.mark.parametrize("with_imu", [True, False])
def test_cameras_are_drawn_where_the_calibration_puts_them(with_imu: bool) -> None:
    made = make_calibration(4, with_imu)
    poses, T_cam0_imu = rig_poses(made)
    for k in range(1, 4):
        transform = made.cameras[k].T_cn_cnm1
        assert transform is not None
        np.testing.assert_allclose(np.linalg.inv(poses[k]) @ poses[k - 1], transform, atol=1e-12)
    if with_imu:
        # Also where only the poses to the IMU are known.
        bare = tuple(dataclasses.replace(camera, T_cn_cnm1=None) for camera in made.cameras)
        again, _ = rig_poses(dataclasses.replace(made, cameras=bare))
        np.testing.assert_allclose(again, poses, atol=1e-12)
        np.testing.assert_array_equal(T_cam0_imu, made.cameras[0].T_cam_imu)
    else:
        assert T_cam0_imu is None


def test_the_scene_is_drawn_as_its_view_says(pair: Calibration) -> None:
    scene = rig_scene(pair)
    assert [name.text for name in scene.names] == ["cam0", "cam1", "imu0"]
    view = look(scene.yaw, scene.pitch)
    np.testing.assert_allclose(view @ view.T, np.eye(2), atol=1e-12)
    # From behind and above: what is further away is higher on the page, what is lower is lower.
    assert view[1, 2] < 0 < view[1, 1]
    for line in scene.lines:
        space = np.array([point.split(",") for point in line.space.split()], float)
        page = np.array([point.split(",") for point in line.page.split()], float)
        np.testing.assert_allclose(space @ view.T + [220.0, 165.0], page, atol=0.21)
        assert np.linalg.norm(space, axis=1).max() < 165.0  # stays in the picture however it is turned
    baseline = next(line for line in scene.lines if line.kind == "baseline")
    ends = np.array([point.split(",") for point in baseline.space.split()], float)
    # The bar is to the scale of the drawing: the cameras are 110 mm apart.
    millimetres = float(scene.bar_name.removesuffix(" mm"))
    assert np.linalg.norm(ends[1] - ends[0]) / scene.bar == pytest.approx(110.0 / millimetres, rel=0.01)


def test_a_lens_is_drawn_with_the_angles_it_looks_at(pair: Calibration) -> None:
    camera = dataclasses.replace(pair.cameras[0], model=PinholeRadtan.create([400.0, 400.0, 320.0, 240.0], [0.0] * 4))
    pixels, angle, straight = _looked(camera)
    np.testing.assert_allclose(angle, np.arctan(np.hypot(*(pixels - [320.0, 240.0]).transpose(2, 0, 1)) / 400.0))
    np.testing.assert_allclose(straight, pixels, atol=1e-9)
    assert lens_picture(camera, "lens").shows.startswith("Contours: degrees off the optical axis, 45° at most")


def test_the_correlation_of_residuals_is_that_of_their_process() -> None:
    random = np.random.default_rng(0)
    white = random.normal(size=20_000)
    assert np.abs(autocorrelation(white, 50)).max() < 5.0 / np.sqrt(len(white))
    coloured = scipy.signal.lfilter([1.0], [1.0, -0.8], white)
    np.testing.assert_allclose(autocorrelation(coloured, 5), 0.8 ** np.arange(1, 6), atol=0.05)
    coloured[::7] = np.nan
    np.testing.assert_allclose(autocorrelation(coloured, 5), 0.8 ** np.arange(1, 6), atol=0.05)


def test_time_offsets_are_drawn_where_they_were_sought(pair: Calibration) -> None:
    picture = time_picture(pair, "time")
    assert picture is not None
    assert "cam0 8.0000 ms ± 0.008 ms; cam1 5.0000 ms ± 0.008 ms" in picture.shows
    assert time_picture(dataclasses.replace(pair, cameras=pair.cameras[:1], blocks=()), "time") is not None
    without = [dataclasses.replace(camera, timeshift_cam_imu=None) for camera in pair.cameras]
    assert time_picture(dataclasses.replace(pair, cameras=tuple(without)), "time") is None


def test_figures_of_one_page_share_no_id() -> None:
    texts = []
    for prefix in ("a", "b"):
        figure, (axes,) = panel()
        axes.plot([0, 1], [0, 1])
        label(axes, "x", "y")
        texts.append(to_svg(figure, prefix))
    first, second = (set(re.findall(r'\bid="([^"]*)"', text)) for text in texts)
    assert first
    assert first.isdisjoint(second)

"""`uwb-slam report`: one page with everything inside, the run's numbers, legible in a browser."""

import base64
import html
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.text import Text
from PIL import Image

from hil_tests.browser import contents_of, find_browser, photograph
from hil_tests.system.recorded_session import record_session
from slam.app.cli import main
from slam.app.run import pictures
from slam.app.run.pictures import SMOOTHED
from slam.app.view.rerun_recording import count_rows
from slam.library.evaluation import ate_rmse_m
from slam.robust.pipeline import RobustSlam

pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Reported:
    session: Path
    page: Path
    n_landmarks: int
    pictures: list["Layout"]

    @property
    def text(self) -> str:
        return self.page.read_text(encoding="utf-8")


class Addresses(HTMLParser):
    """Collects everything in a page that could make a browser ask somebody."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.tags: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.found += [v for k, v in attrs if k in {"src", "href", "srcset", "data"} and v]


@dataclass(frozen=True)
class Layout:
    """What of a picture is not as it should be: texts beyond its edge, legends over its data."""

    cut: list[str]
    n_hiding: int


def layout_of(figure: Figure) -> Layout:
    figure.draw_without_rendering()
    edge = figure.bbox.padded(1.0)
    axes_of = [axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)]
    ticks = {text for axis in axes_of for text in axis.get_ticklabels()}  # also unseen ones
    cut = []
    for text in figure.findobj(lambda found: isinstance(found, Text)):
        assert isinstance(text, Text)
        if text not in ticks and text.get_visible() and text.get_text():
            box = text.get_window_extent()
            if not edge.x0 <= box.x0 <= box.x1 <= edge.x1:
                cut.append(text.get_text())
    data = [axes.bbox for axes in figure.axes if axes.axison]
    legends = [legend.get_window_extent() for legend in figure.findobj(Legend)]
    return Layout(cut=cut, n_hiding=sum(box.overlaps(each) for box in legends for each in data))


@pytest.fixture(scope="module")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Reported:
    session = tmp_path_factory.mktemp("report") / "session.mcap"
    record = record_session(session, "robust")
    assert record.last is not None
    layouts: list[Layout] = []

    def svg_of(draw: Callable[..., None], *arguments: object, **size: float) -> str:
        figures: list[Figure] = []

        def seen(figure: Figure, *given: object) -> None:
            draw(figure, *given)
            figures.append(figure)

        svg = pictures.svg_of(seen, *arguments, **size)
        layouts.extend(map(layout_of, figures))
        return svg

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("slam.app.commands.report.svg_of", svg_of)
        patch.setattr(RobustSlam, "step", None)  # what was recorded is shown without SLAM
        patch.setattr(RobustSlam, "step_detections", None)
        assert main(["report", str(session.parent)]) == 0
    return Reported(
        session=session,
        page=session.with_name("report.html"),
        n_landmarks=len(record.last.landmark_ids),
        pictures=layouts,
    )


@pytest.fixture(scope="module")
def replayed(reported: Reported, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return the numbers of a replay of the session."""
    out = tmp_path_factory.mktemp("replayed")
    assert main(["replay", str(reported.session), "--out", str(out)]) == 0
    numbers: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return numbers


def test_the_page_loads_nothing_from_elsewhere(reported: Reported) -> None:
    addresses = Addresses()
    addresses.feed(reported.text)
    assert addresses.tags.isdisjoint({"script", "link", "iframe", "object", "embed", "base"})
    # map, errors, consistency, echoes, links and radar image; wide and narrow
    assert len(addresses.found) == 12
    for address in addresses.found:
        kind, _, data = address.partition(",")
        assert kind == "data:image/svg+xml;base64"
        svg = base64.b64decode(data).decode()
        assert svg.startswith("<?xml")
        # what it refers to lies in itself: the names of XML dialects are not addresses to ask
        references = re.findall(r'(?:xlink:)?href="([^"]*)"|url\(([^)]*)\)', svg)
        assert references
        assert all((href or url).startswith(("#", "data:")) for href, url in references)
    assert "@import" not in reported.text
    assert "url(" not in reported.text


def test_the_numbers_are_those_of_a_replay(reported: Reported, replayed: dict[str, Any]) -> None:
    ate_m = replayed["ate_rmse_m"]
    shown = re.findall(r'<td>SLAM ATE</td><td class="value">([0-9.]+) mm</td>', reported.text)
    assert shown == [f"{1e3 * ate_m:.1f}"]
    assert f"{reported.n_landmarks} for " in reported.text
    assert "simulated data" in reported.text


def test_a_lost_frame_and_a_fault_are_told_and_escaped(reported: Reported) -> None:
    row = re.findall(r"<tr><td[^>]*>rear_left</td>(.*?)</tr>", reported.text)[0]
    cells = re.findall(r"<td[^>]*>(.*?)</td>", row)
    assert cells[3].startswith("1 (")  # lost
    assert cells[4:6] == ["1", "1"]  # most in a row, faults
    assert "Warnings: 1<" in reported.text
    assert "CRC of 5731 bytes &lt;does not fit&gt;" in reported.text
    others = re.findall(r"<tr><td[^>]*>front_left</td>(.*?)</tr>", reported.text)[0]
    assert re.findall(r"<td[^>]*>(.*?)</td>", others)[3:6] == ["0 (0.00 %)", "0", "0"]


def test_the_first_sentences_say_what_was_done_and_how_good_it_was(
    reported: Reported, replayed: dict[str, Any]
) -> None:
    done, verdict = re.findall(r'<p class="verdict">(.*?)</p>', reported.text)
    summary = replayed
    assert f"{reported.n_landmarks} landmarks in {summary['frames']} frames of 4 radars" in done
    assert "1 frames were lost, and there were 1 faults" in done
    ate_m, odometry_m = summary["ate_rmse_m"], summary["odometry_ate_rmse_m"]
    assert ("better" in verdict) is (ate_m < odometry_m)
    assert f"{1e3 * ate_m:.1f} mm" in verdict
    assert f"{1e3 * odometry_m:.1f} mm" in verdict


def test_settings_are_shown_as_json_has_them(reported: Reported) -> None:
    lines = re.findall(r"(?m)^[a-z_.]+ = (.*?)(?:</pre>.*)?$", reported.text)
    assert len(lines) > 50
    for line in lines:
        json.loads(html.unescape(line))


@pytest.mark.rare
def test_the_same_session_gives_the_same_page(reported: Reported, tmp_path: Path) -> None:
    again = tmp_path / "again.html"
    assert main(["report", str(reported.session), "--out", str(again)]) == 0
    assert again.read_bytes() == reported.page.read_bytes()


@pytest.mark.skipif(find_browser() is None, reason="no Chromium is installed")
def test_a_browser_without_network_shows_it(reported: Reported, tmp_path: Path) -> None:
    photograph(reported.page, tmp_path / "page.png", width=1000, height=1200)
    with Image.open(tmp_path / "page.png") as picture:
        assert picture.size == (1000, 1200)
        colours = picture.convert("RGB").getcolors(maxcolors=1 << 20)
    assert colours is not None
    seen = {colour for _, colour in colours}
    # ground of the "simulated" mark, the estimate's blue and the landmarks' red of the map
    assert {(255, 243, 214), (31, 111, 208), (194, 37, 92)} <= seen


_FRAMES = """\
<!DOCTYPE html><title>?</title><body></body><script>
const page = {page}, widths = [];
for (const width of [1100, 400]) {{
  const frame = document.createElement("iframe");
  frame.width = width;
  frame.onload = () => {{
    const root = frame.contentDocument.documentElement;
    const images = [...frame.contentDocument.images].map(image => image.naturalWidth);
    const cells = [...frame.contentDocument.querySelectorAll("td")];
    const right = Math.max(...cells.map(cell => cell.getBoundingClientRect().right));
    widths.push([width, Math.max(root.scrollWidth, right), ...images]);
    if (widths.length == 2) document.title = JSON.stringify(widths.sort((a, b) => b[0] - a[0]));
  }};
  frame.srcdoc = page;
  document.body.append(frame);
}}
</script>
"""


@pytest.mark.skipif(find_browser() is None, reason="no Chromium is installed")
def test_nothing_is_wider_than_a_screen_or_a_telephone(reported: Reported, tmp_path: Path) -> None:
    long_port = f"/dev/{'long/' * 40}ttyACM0"
    text, n_ports = re.subn('(?<=data-name="port">)[^<]*', long_port, reported.text)
    assert n_ports > 0
    (tmp_path / "frames.html").write_text(
        _FRAMES.format(page=json.dumps(text).replace("</", "<\\/")), encoding="utf-8"
    )
    dumped = contents_of(tmp_path / "frames.html")
    wide, narrow = json.loads(html.unescape(re.findall("<title>(.*?)</title>", dumped)[0]))
    assert wide[0] >= wide[1]  # room and need [px]
    assert narrow[0] >= narrow[1]
    # an inch has 96 px: text of 10 points then has 11 px or more on the telephone
    assert all(width > 900 for width in wide[2:])
    assert all(400 < width < 440 for width in narrow[2:])
    assert len(wide) == len(narrow) == 8


def test_only_tables_of_many_columns_repeat_their_names_on_a_telephone(reported: Reported) -> None:
    tables = re.findall('<div class="(wide[^"]*)"><table><tr>(.*?)</tr>', reported.text)
    assert len(tables) == 3  # landmarks, links, parameters
    for kind, head in tables:
        assert ("cards" in kind) == (head.count("<th>") > 5)


@pytest.mark.rare
def test_the_smoothed_path_has_its_number_and_is_on_the_map(tmp_path: Path) -> None:
    record = record_session(tmp_path / "session.mcap", "robust")
    assert record.whole_smoothed is not None
    assert main(["report", str(tmp_path)]) == 0
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    ate_m = ate_rmse_m(record.whole_smoothed.poses[:, :2], record.states.truth[:, :2])
    shown = re.findall(r'<td>smoothed ATE</td><td class="value">([0-9.]+) mm</td>', page)
    assert shown == [f"{1e3 * ate_m:.1f}"]
    drawn = [base64.b64decode(data).decode() for data in re.findall(r'base64,([^"]*)"', page)]
    coloured = [SMOOTHED in picture for picture in drawn]
    # map, errors, consistency; each narrow and wide
    assert sorted(coloured) == [False] * 6 + [True] * 6


def test_no_text_is_cut_and_no_legend_lies_over_data(reported: Reported) -> None:
    assert reported.pictures == [Layout(cut=[], n_hiding=0)] * 12


@pytest.mark.rare
def test_of_a_real_drive_it_tells_no_error(tmp_path: Path) -> None:
    record_session(tmp_path / "session.mcap", "robust", has_truth=False)
    assert main(["report", str(tmp_path)]) == 0
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "measured data" in page
    assert "simulated" not in page
    assert "The truth of this drive is unknown" in page
    assert "Whether SLAM was better than the wheels is unknown" in page
    assert "begun 2026-09-21 14:13:20 UTC" in page
    assert "odometry clock: monotonic" in page
    assert "ATE" not in page
    assert "nearest truth" not in page
    assert "Errors over time" not in page
    assert len(re.findall(r'base64,([^"]*)"', page)) == 12
    assert main(["view", str(tmp_path / "session.mcap"), "--out", str(tmp_path / "v.rrd")]) == 0
    rows = count_rows(tmp_path / "v.rrd")
    assert rows["/map/estimate/path"] > 0
    assert rows["/map/smoothed/path"] == rows["/map/smoothed/landmarks"] == 1
    assert not [name for name in rows if name.startswith("/map/truth")]
    assert "/error/slam" not in rows

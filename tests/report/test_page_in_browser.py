"""report.html and failed.html in a browser: drawn, usable by keyboard, and alone in the world."""

import itertools
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select, WebDriverWait
from test_figures import LOAD
from test_page import HOSTILE, diagnosed, hostile
from test_room import in_room_pulled

from dlo_casadi.errors import DloError
from dlo_casadi.report.geometry import beside
from dlo_casadi.report.page import report_page
from dlo_casadi.report.page_failure import failure_page

BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(
    BROWSER is None or DRIVER is None, reason="needs chromium and chromium-driver"
)
WIDTHS = [390, 1440]  # px, a phone and a large screen
PAGES = ["photographs", "centerlines", "failed", "space", "failed in space"]


@pytest.fixture(scope="module")
def pages(photographed, outcome, in_room, tmp_path_factory):
    """A page of each kind, as files."""
    folder = tmp_path_factory.mktemp("pages")
    lost = replace(
        photographed.poses[0],
        points=np.zeros((0, 2)),
        to_pixels=None,
        problem="no cable found. Try: another background.",
    )
    full = diagnosed(photographed)
    texts = {
        "photographs": report_page(full),
        "centerlines": report_page(diagnosed(outcome, unexplained=LOAD, verdict="unexplained")),
        "failed": failure_page(
            photographed.config, DloError("nothing fits"), (lost, *photographed.poses[1:])
        ),
        "space": report_page(in_room_pulled(in_room)),
        "failed in space": failure_page(in_room.config, DloError("nothing fits"), in_room.poses),
        "hostile": report_page(hostile(outcome)),
    }
    for name, text in texts.items():
        (folder / f"{name}.html").write_text(text, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def browser():
    options = webdriver.ChromeOptions()
    options.binary_location = BROWSER
    for argument in ("headless=new", "no-sandbox", "disable-gpu", "disable-dev-shm-usage"):
        options.add_argument(f"--{argument}")
    options.add_argument("--force-prefers-reduced-motion")  # a click must not miss while scrolling
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    yield driver
    driver.quit()


@pytest.fixture
def visit(browser, pages):
    """Open a page at a width and wait until it is drawn; the logs start with it."""

    def opened(name, width=1440):
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        browser.get("about:blank")
        browser.get_log("browser"), browser.get_log("performance")
        browser.get((pages / f"{name}.html").as_uri())
        wait(browser, "return document.documentElement.dataset.ready === 'yes'")
        return browser

    return opened


def wait(browser, script):
    """Until a script returns something true."""
    return WebDriverWait(browser, 20, poll_frequency=0.05).until(
        lambda driver: driver.execute_script(script)
    )


def find(browser, selector):
    return browser.find_element(By.CSS_SELECTOR, selector)


def press(browser, *keys):
    webdriver.ActionChains(browser).send_keys(*keys).perform()


@pytest.mark.parametrize("name", [*PAGES, "hostile"])
def test_nothing_leaves_the_page_and_nothing_is_complained_of(visit, pages, name):
    browser = visit(name)
    complaints = [entry for entry in browser.get_log("browser") if entry["level"] != "INFO"]
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = {
        message["params"]["request"]["url"]
        for message in messages
        if message["method"] == "Network.requestWillBeSent"
    }

    assert complaints == []
    page = (pages / f"{name}.html").as_uri()
    assert page in asked
    assert {url for url in asked if not url.startswith("data:")} == {page}
    assert browser.execute_script("return performance.getEntriesByType('resource')") == []


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", PAGES)
def test_nothing_is_wider_than_the_screen(visit, name, width):
    browser = visit(name, width)
    assert browser.execute_script("return innerWidth") == width
    assert browser.execute_script("return document.scrollingElement.scrollWidth") <= width

    browser.execute_script("document.querySelector('.enlarge').click()")
    assert browser.execute_script("return document.scrollingElement.scrollWidth") <= width
    wide = "const box = document.getElementById('large'); return box.scrollWidth - box.clientWidth"
    assert browser.execute_script(wide) <= 0


@pytest.mark.parametrize("name", ["photographs", "centerlines", "space"])
def test_every_chart_is_drawn(visit, name):
    browser = visit(name)
    ink = """
        const inked = (root) => [...root.querySelectorAll("*")].some((node) => {
          if (node.shadowRoot && inked(node.shadowRoot)) return true;
          if (node.tagName !== "CANVAS" || !node.width) return false;
          const data = node.getContext("2d").getImageData(0, 0, node.width, node.height).data;
          const dark = data.reduce((n, x, i) => n + (i % 4 < 3 && x < 128 && data[i | 3] > 0), 0);
          return dark > 500;
        });
        const charts = [...document.querySelectorAll(".chart")];
        return charts.every(inked) ? charts.length : 0;
    """
    assert wait(browser, ink) == len(browser.find_elements(By.CSS_SELECTOR, ".chart"))


@pytest.mark.parametrize("name", ["photographs", "failed"])
def test_a_picture_is_enlarged_and_closed_by_keyboard(visit, name):
    browser = visit(name)
    small = browser.find_elements(By.CSS_SELECTOR, ".enlarge")[1]
    width = small.rect["width"]
    small.send_keys(Keys.ENTER)
    dialog = find(browser, "#large")

    assert dialog.get_attribute("open") is not None
    assert find(browser, "#large-title").text.startswith("pose_03")
    assert find(browser, "#large-picture image").get_attribute("href").startswith("data:image")
    assert find(browser, "#large-picture svg").rect["width"] > 1.5 * width
    press(browser, Keys.ARROW_RIGHT)
    assert find(browser, "#large-title").text == "pose_04"
    press(browser, Keys.ARROW_LEFT, Keys.ARROW_LEFT)
    assert find(browser, "#large-title").text == "pose_01"
    press(browser, Keys.ESCAPE)
    assert dialog.get_attribute("open") is None
    wait(browser, "return document.activeElement.dataset.number === '0'")


def test_a_picture_is_enlarged_by_a_click_and_closed_by_one_beside_it(visit):
    browser = visit("photographs", 390)
    browser.find_elements(By.CSS_SELECTOR, ".enlarge")[0].click()
    assert find(browser, "#large").get_attribute("open") is not None
    find(browser, "#large-close").click()
    assert find(browser, "#large").get_attribute("open") is None


def chosen(browser, kind):
    """Residual that the chart shows of the chosen pose."""
    return browser.execute_script(f"return Array.from(model('chosen-{kind}').data.r)")


def test_the_residuals_are_those_of_the_chosen_pose(visit, photographed):
    browser = visit("photographs")
    assert chosen(browser, "after") == []
    Select(find(browser, "#pose-choice")).select_by_visible_text("pose_03 (held out)")

    stage, noise = photographed.stage("batch"), photographed.measurement.std
    for kind in ("before", "after"):  # the closed stage is the batch once more
        shown = chosen(browser, kind)
        assert shown == pytest.approx(stage.shapes["pose_03"].residual / noise, rel=1e-6)
    assert f"{1e3 * stage.shapes['pose_03'].rmse:.3g} mm" in find(browser, "#pose-said").text

    find(browser, "#pose-next").send_keys(Keys.SPACE)
    assert chosen(browser, "after") == pytest.approx(
        stage.shapes["pose_04"].residual / noise, rel=1e-6
    )
    find(browser, "#pose-choice").send_keys(Keys.HOME)
    assert chosen(browser, "after") == []
    find(browser, "#pose-previous").send_keys(Keys.ENTER)
    assert chosen(browser, "after") == pytest.approx(
        stage.shapes["pose_09"].residual / noise, rel=1e-6
    )


def test_a_link_below_a_picture_chooses_its_pose(visit):
    browser = visit("photographs")
    browser.execute_script("document.querySelector('[data-choose=\"2\"]').click()")
    assert Select(find(browser, "#pose-choice")).first_selected_option.text == "pose_04"


def test_deviations_are_enlarged_as_told(visit, photographed):
    """Ten times: the predicted points are ten times as far from the measured ones, on the board."""
    browser = visit("photographs")
    whole = find(browser, "#after-0").get_attribute("points")
    find(browser, ".layers [value='10']").click()
    shown = find(browser, "#after-0").get_attribute("points")
    points = np.array([pair.split(",") for pair in shown.split()], dtype=float)

    pose = photographed.poses[0]
    tenfold = beside(pose, photographed.stage("batch").shapes[pose.name], 10.0)
    # The camera's perspective bends a millimetre by far less than a tenth of a pixel.
    assert points == pytest.approx(pose.to_pixels(tenfold), abs=0.1)
    assert find(browser, "#large [value='10']").get_property("checked")
    find(browser, ".layers [value='1']").click()
    assert find(browser, "#after-0").get_attribute("points") == whole


def test_lines_and_the_photograph_are_hidden_as_told(visit):
    browser = visit("photographs")
    for layer, selector in (
        ("measured", ".picture use.measured"),
        ("before", ".picture use.before"),
        ("after", ".picture use.after"),
        ("photograph", ".picture image"),
    ):
        shown = f"""
            const style = getComputedStyle(document.querySelector('{selector}'));
            return style.display !== 'none' && style.visibility !== 'hidden';
        """
        assert browser.execute_script(shown), layer
        find(browser, f".layers [data-layer={layer}]").send_keys(Keys.SPACE)
        assert not browser.execute_script(shown), layer


def test_the_whole_photograph_is_shown_on_demand(visit):
    browser = visit("photographs")
    svg = find(browser, ".gallery svg[data-whole]")
    part = svg.get_dom_attribute("viewBox")
    find(browser, ".layers [data-layer=whole]").click()
    assert svg.get_dom_attribute("viewBox") == "-0.5 -0.5 1280.0 720.0" != part


def test_harmful_names_appear_as_text(visit):
    browser = visit("hostile")

    assert find(browser, "h1").text == HOSTILE
    assert HOSTILE.replace("/", "") in find(browser, ".gallery h3").text
    assert HOSTILE in find(browser, ".warnings").text
    assert browser.find_elements(By.CSS_SELECTOR, "img, [onerror]") == []


@pytest.mark.parametrize("name", PAGES)
def test_the_page_is_built_for_those_who_do_not_see_it(visit, name):
    browser = visit(name)
    levels = browser.execute_script(
        "return [...document.querySelectorAll('body :is(h1, h2, h3, h4)')]"
        ".filter((x) => !x.closest('dialog')).map((x) => Number(x.tagName[1]))"
    )
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(b <= a + 1 for a, b in itertools.pairwise(levels)), levels
    nameless = browser.execute_script("""
        const said = (node) => node.getAttribute("aria-label") || node.textContent.trim()
          || node.labels?.length;
        const all = (selector) => [...document.querySelectorAll(selector)];
        return [
          ...all("table").filter((table) => !table.caption?.textContent.trim()),
          ...all("[role=img], [role=region], nav, form").filter((x) => !x.ariaLabel),
          ...all("button, a, input, select").filter((node) => !said(node)),
          ...all("th:not([scope])"),
        ].map((node) => node.outerHTML.slice(0, 80));
    """)
    assert nameless == []
    assert browser.execute_script("return document.documentElement.lang") == "en"


def test_charts_fit_the_paper_they_are_printed_on(visit):
    browser = visit("photographs")
    widths = """
        const charts = [...document.querySelectorAll(".chart")];
        const wide = charts.map((chart) => chart.offsetWidth);
        dispatchEvent(new Event("beforeprint"));
        const zoom = charts.map((chart) => Number(chart.style.zoom));
        dispatchEvent(new Event("afterprint"));
        return [wide, zoom, charts.map((chart) => chart.style.zoom)];
    """
    wide, zoom, after = browser.execute_script(widths)
    assert max(wide) > 1000  # px; between the margins of A4 there are 688
    assert max(np.multiply(wide, zoom)) <= 681
    assert set(after) == {""}


def points_of(browser, selector):
    text = find(browser, selector).get_dom_attribute("points")
    return np.array([pair.split(",") for pair in text.split()], dtype=float)


@pytest.mark.parametrize("width", WIDTHS)
def test_a_drag_turns_all_rooms_and_enlarges_none(visit, width):
    browser = visit("space", width)
    before = [points_of(browser, f"#after-{k}") for k in (0, 1)]
    pull = points_of(browser, ".scene .pull")
    room = find(browser, ".gallery .room")
    chain = webdriver.ActionChains(browser).move_to_element(room).click_and_hold()
    chain.move_by_offset(60, 0).release().perform()
    wait(browser, "return document.querySelector('#after-0').dataset.whole !== undefined")

    for k in (0, 1):
        after = points_of(browser, f"#after-{k}")
        assert np.abs(after - before[k]).max() > 10
    assert find(browser, "#large").get_attribute("open") is None
    assert np.abs(points_of(browser, ".scene .pull") - pull).max() > 1
    find(browser, ".enlarge").click()
    assert find(browser, "#large").get_attribute("open") is not None


def test_rooms_are_seen_from_where_one_chooses(visit, in_room):
    """From the front: world x to the right, height up; deviations are enlarged there, too."""
    browser = visit("space")
    find(browser, ".layers [data-view='-90.0 0.0']").click()
    wait(browser, "return document.querySelector('#after-0').dataset.whole !== undefined")
    pose = in_room.poses[0]
    shown = points_of(browser, "#measured-0")
    expected = 1e3 * pose.points[:, [0, 2]] * [1, -1]
    assert np.diff(shown, axis=0) == pytest.approx(np.diff(expected, axis=0), abs=0.03)

    find(browser, ".layers [value='10']").click()
    tenfold = beside(pose, in_room.stage("batch").shapes[pose.name], 10.0)
    moved = 1e3 * (tenfold - pose.points)[:, [0, 2]] * [1, -1]
    assert points_of(browser, "#after-0") - shown == pytest.approx(moved, abs=0.2)


def test_residuals_in_space_have_two_directions(visit, in_room):
    browser = visit("space")
    Select(find(browser, "#pose-choice")).select_by_visible_text("pose_01")
    residual = in_room.stage("batch").shapes["pose_01"].residual / in_room.measurement.std
    assert chosen(browser, "after") == pytest.approx(residual[:, 0], rel=1e-5, abs=1e-6)
    assert chosen(browser, "after-z") == pytest.approx(residual[:, 1], rel=1e-5, abs=1e-6)

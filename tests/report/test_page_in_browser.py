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
from dlo_casadi.report.page import failure_page, report_page
from dlo_casadi.report.scene import beside

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
    """Open a page at a width; the logs start with it."""

    def opened(name, width=1440):
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        browser.get("about:blank")
        browser.get_log("browser"), browser.get_log("performance")
        browser.get((pages / f"{name}.html").as_uri())
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
@pytest.mark.parametrize("width", WIDTHS)
def test_every_chart_is_drawn(visit, name, width):
    """With ink that is seen, in letters that can be read, none of them beyond its chart."""
    browser = visit(name, width)
    charts = browser.find_elements(By.CSS_SELECTOR, ".chart")
    assert len(charts) >= 4
    look = """
        const svg = arguments[0].querySelector("svg"), own = svg.getBoundingClientRect();
        const box = (node) => node.getBoundingClientRect();
        const texts = [...svg.querySelectorAll("text")];
        const size = (node) => parseFloat(getComputedStyle(node).fontSize) * svg.getScreenCTM().a;
        const out = texts.filter((node) => {
          const b = box(node);
          return b.left < own.left - 2 || b.right > own.right + 2 || b.top < own.top - 2
            || b.bottom > own.bottom + 2;
        });
        const ink = [...svg.querySelectorAll("path")].filter((node) => box(node).width > 0
          || box(node).height > 0);
        return [own.width, ink.length, Math.min(...texts.map(size)), out.map((x) => x.textContent)];
    """
    for chart in charts:
        wide, ink, letters, out = browser.execute_script(look, chart)
        assert 300 < wide <= width
        assert ink > 10
        assert letters > (9.3 if width == 390 else 13)
        assert out == []


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


def chosen(browser):
    """Names of the lines of the residuals that stand out: thicker than the others."""
    return browser.execute_script("""
        return [...document.querySelectorAll("[id^=residual-]")].filter((line) =>
          parseFloat(getComputedStyle(line.querySelector("path")).strokeWidth) > 2
        ).map((line) => line.id).sort();
    """)


def test_the_residuals_are_those_of_the_chosen_pose(visit, photographed):
    browser = visit("photographs")
    assert chosen(browser) == []
    Select(find(browser, "#pose-choice")).select_by_visible_text("pose_03 (held out)")
    assert chosen(browser) == ["residual-after-1", "residual-before-1"]
    error = f"{1e3 * photographed.stage('batch').shapes['pose_03'].rmse:.3g} mm"
    assert error in find(browser, "#pose-said").text
    title = find(browser, "#residual-after-1 title").get_attribute("textContent")
    assert title == f"pose_03 (held out), RMS distance {error}"

    find(browser, "#pose-next").send_keys(Keys.SPACE)
    assert chosen(browser) == ["residual-after-2", "residual-before-2"]
    find(browser, "#pose-choice").send_keys(Keys.HOME)
    assert chosen(browser) == []
    find(browser, "#pose-previous").send_keys(Keys.ENTER)
    assert chosen(browser) == ["residual-after-4", "residual-before-4"]


def test_a_click_on_a_pose_among_the_errors_chooses_it(visit):
    browser = visit("photographs")
    row = find(browser, "#choose-3")
    webdriver.ActionChains(browser).move_to_element(row).click().perform()
    assert Select(find(browser, "#pose-choice")).first_selected_option.text == "pose_05"
    assert chosen(browser) == ["residual-after-3", "residual-before-3"]
    assert 0 <= browser.execute_script("return residuals.getBoundingClientRect().top") < 900


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
    browser = visit("photographs", 688)  # px, A4 between its margins
    widths = "return [...document.querySelectorAll('.chart svg')].map((x) => x.clientWidth)"
    for medium in ("screen", "print"):
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": medium})
        assert 300 < max(browser.execute_script(widths)) <= (600 if medium == "screen" else 454)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})


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


def test_residuals_in_space_have_two_directions(visit):
    browser = visit("space")
    Select(find(browser, "#pose-choice")).select_by_visible_text("pose_01")
    assert chosen(browser) == [
        f"residual-{kind}-0-{axis}" for kind in ("after", "before") for axis in "yz"
    ]

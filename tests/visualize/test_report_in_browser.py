"""The page works in a real browser, from file://, with hostile names of frames, classes and the run."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from helpers.browser import chromium, console_problems, requested_urls, screenshot_of, set_viewport
from helpers.finished_run import finished_run
from helpers.synthetic_scene import cached_street

from directshape_torch.files.atomic_files import write_png
from directshape_torch.io.result_files import read_shapes, write_shapes
from directshape_torch.io.run_folder import read_record, summary_path
from directshape_torch.io.run_manifest import hash_fields, write_manifest
from directshape_torch.rig.estimate import RigEstimate
from directshape_torch.rig.rig_file import RIG_FILE, RIG_PICTURE, save_rigs
from directshape_torch.visualize.make_report import make_report

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

FRAMES = ("<img src=x onerror=boom()>", '"><script>boom()', "zz'&amp;{{data}}")
FIRST_FRAME = sorted(FRAMES)[0]
CAR_TYPE = "<script>boom()</script>"
TRACK = "<b>7</b>"
OUT_NAME = "<svg onload=boom()>&lt;"
# Software rendering on a busy machine takes its time.
PATIENCE_S = 40.0


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = finished_run(tmp_path_factory.mktemp("browser"), FRAMES, out_name=OUT_NAME, car_type=CAR_TYPE)
    _, scene = cached_street()
    rig = RigEstimate.of_frames(scene.frames)
    save_rigs(run.out / RIG_FILE, [rig])
    known = run.folder().manifest
    manifest = replace(known, sha256={**known.sha256, "stereo_bias": hash_fields([rig.field])})
    write_manifest(summary_path(run.out), manifest)
    # The first car goes through all frames, in the last one as somebody else.
    for path, part in zip(sorted((run.out / "shapes").iterdir()), (0, 0, 1), strict=True):
        shapes = read_shapes(path)
        made_of = replace(read_record(path, shapes), run=manifest.hash).text()
        write_shapes(path, replace(shapes, tracks=(TRACK, ""), track_parts=np.array([part, -1]), made_of=made_of))
    write_png(run.out / RIG_PICTURE, np.zeros((40, 3000, 3), np.uint8))
    return make_report(run.inputs(), run.out.parent / "a page#1.html").path


@pytest.fixture(scope="module")
def browser() -> Iterator[Chrome]:
    with chromium() as driver:
        # A hostile name that runs leaves its mark before the page's own scripts do.
        script = {"source": "window.booms = 0; window.boom = () => { window.booms += 1; };"}
        driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", script)
        yield driver


@pytest.fixture
def opened(browser: Chrome, page: Path) -> Iterator[Chrome]:
    """The page in a wide light window; at the end nothing may have been fetched, reported or run."""
    set_viewport(browser, 1280)
    open_page(browser, page)
    yield browser
    assert console_problems(browser) == []
    assert {url for url in requested_urls(browser) if url != page.as_uri()} == set()
    assert browser.execute_script("return window.booms") == 0


def open_page(browser: Chrome, page: Path) -> None:
    browser.get(page.as_uri())
    until(lambda: browser.execute_script("return document.documentElement.dataset.ready") == "true")


def until(condition: Callable[[], Any]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, "the page did not get there in time"
        time.sleep(0.05)


def find(browser: Chrome, selector: str) -> Any:
    return browser.find_element("css selector", selector)


def texts(browser: Chrome, selector: str) -> list[str]:
    script = "return [...document.querySelectorAll(arguments[0])].map((node) => node.textContent)"
    return list(browser.execute_script(script, selector))


def show_scene(browser: Chrome) -> Any:
    scene = find(browser, "#scene")
    browser.execute_script("arguments[0].scrollIntoView({ block: 'center' })", scene)
    until(lambda: scene.get_attribute("data-ready"))
    time.sleep(0.3)
    return scene


def test_hostile_names_are_text_and_the_picture_of_the_rig_fits(opened: Chrome) -> None:
    assert OUT_NAME in find(opened, "h1").text
    assert OUT_NAME in opened.title
    assert set(texts(opened, ".open-car span:first-child")) == set(FRAMES)
    assert set(texts(opened, "#frame-choice option")) == set(FRAMES)
    assert CAR_TYPE in texts(opened, "#car-rows td")
    assert opened.execute_script("return document.querySelectorAll('main img[src=x], main script, h1 svg').length") == 0
    # The picture of the rig is far wider than the page, and fits.
    opened.execute_script("document.querySelector('#rig details').open = true")
    until(lambda: opened.execute_script("return document.querySelector('#rig img').complete"))
    assert 0 < find(opened, "#rig img").size["width"] <= 1280


def test_sort_by_click_and_by_key_and_filter(opened: Chrome) -> None:
    head = opened.find_element("xpath", "//th[button[starts-with(., 'Distance')]]")
    button = head.find_element("css selector", "button")

    def distances() -> list[float]:
        return [float(text) for text in texts(opened, "td[data-title='Distance [m]']")]

    assert head.get_attribute("aria-sort") == "none"
    button.click()
    assert head.get_attribute("aria-sort") == "descending"
    assert distances() == sorted(distances(), reverse=True)
    opened.execute_script("arguments[0].focus()", button)
    button.send_keys("\ue007")  # Enter
    assert head.get_attribute("aria-sort") == "ascending"
    assert distances() == sorted(distances())
    assert len(set(distances())) > 1
    assert len(opened.find_elements("css selector", "th[aria-sort=ascending], th[aria-sort=descending]")) == 1
    find(opened, "#search").send_keys("ONERROR")
    assert set(texts(opened, ".open-car span:first-child")) == {FRAMES[0]}
    assert find(opened, "#car-count").text == "2 of 2 cars shown, 6 in all"


def test_thumbnails_come_into_view_and_open_a_car_with_its_residual_maps(opened: Chrome) -> None:
    image = find(opened, "#car-rows img.thumbnail")
    opened.execute_script("arguments[0].scrollIntoView()", image)
    until(lambda: opened.execute_script("return arguments[0].naturalWidth", image) > 20)
    assert FIRST_FRAME in image.get_attribute("alt")
    assert opened.execute_script("return [...document.images].every((image) => image.alt !== '')")
    find(opened, ".open-car").click()
    dialog = find(opened, "#car-dialog")
    assert dialog.is_displayed()
    assert find(opened, "#car-dialog h2").text == f"Car {FIRST_FRAME}, line 1"
    assert dialog.find_elements("css selector", "img.map") == []
    find(opened, "#show-maps").click()
    maps = dialog.find_elements("css selector", "img.map")
    assert len(maps) == 4
    until(lambda: all(opened.execute_script("return arguments[0].naturalWidth", image) > 10 for image in maps))
    assert "photometric" in dialog.text
    assert len(dialog.find_elements("css selector", "svg.chart polyline")) == 2
    find(opened, "body").send_keys("\ue00c")  # Escape
    assert not dialog.is_displayed()


def test_3d_draws_turns_and_opens_cars(opened: Chrome) -> None:
    from selenium.webdriver import ActionChains

    scene = show_scene(opened)
    first = screenshot_of(scene)
    # Boxes, ground and painted cars, not one even colour.
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 50
    ActionChains(opened).move_to_element(scene).click_and_hold().move_by_offset(120, 20).release().perform()
    time.sleep(0.3)
    turned = screenshot_of(scene)
    assert np.mean(np.any(first != turned, axis=-1)) > 0.02
    find(opened, ".open-car").click()
    find(opened, "#show-in-3d").click()
    until(lambda: scene.get_attribute("data-car"))
    assert not find(opened, "#car-dialog").is_displayed()
    time.sleep(0.3)
    # The view now looks at the middle of that car: a click there opens it.
    ActionChains(opened).move_to_element(scene).click().perform()
    assert find(opened, "#car-dialog").is_displayed()
    assert scene.get_attribute("data-car") in find(opened, "#car-dialog h2").text


def test_3d_shows_a_car_of_another_frame(opened: Chrome) -> None:
    from selenium.webdriver import ActionChains

    opened.execute_script(
        """window.contexts = 0;
        const { getContext } = HTMLCanvasElement.prototype;
        HTMLCanvasElement.prototype.getContext = function (...words) {
          window.contexts += 1;
          return getContext.apply(this, words);
        };"""
    )
    scene = find(opened, "#scene")
    # First with no viewer yet, then with one that shows another frame.
    for number in (-1, 0):
        car = opened.find_elements("css selector", ".open-car")[number]
        name = opened.execute_script("return arguments[0].textContent", car)
        frame = opened.execute_script("return arguments[0].firstChild.textContent", car)
        opened.execute_script("arguments[0].click()", car)
        opened.execute_script("document.getElementById('show-in-3d').click()")
        until(lambda name=name: (scene.get_attribute("data-car") or "").replace(",", "") == name)
        assert frame in scene.get_attribute("data-ready")
        time.sleep(0.3)
        ActionChains(opened).move_to_element(scene).click().perform()
        assert find(opened, "#car-dialog h2").text == f"Car {scene.get_attribute('data-car')}"
        find(opened, "#close-car").click()
    assert opened.execute_script("return window.contexts") == 1


def test_3d_turns_by_a_finger(opened: Chrome) -> None:
    set_viewport(opened, 390, 844)
    scene = show_scene(opened)
    area = opened.execute_script("return arguments[0].getBoundingClientRect().toJSON()", scene)
    middle = {"x": area["x"] + area["width"] / 2, "y": area["y"] + area["height"] / 2}
    before = screenshot_of(scene)
    steps = [("touchStart", 0), ("touchMove", 20), ("touchMove", 60), ("touchMove", 100), ("touchEnd", None)]
    for kind, along in steps:
        points = [] if along is None else [{"x": middle["x"] + along, "y": middle["y"]}]
        opened.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    time.sleep(0.3)
    assert np.mean(np.any(before != screenshot_of(scene), axis=-1)) > 0.02
    assert not find(opened, "#car-dialog").is_displayed()


def test_tracks_are_named(opened: Chrome) -> None:
    """The table says which views are of one car, the summary what was split, and each view knows the whole path."""
    tracks = dict(zip(texts(opened, ".open-car"), texts(opened, "td[data-title='Track']"), strict=True))
    assert sorted(tracks.values()) == [TRACK, TRACK, f"{TRACK}, part 1"] + ["\u2013"] * 3
    assert "1, 1 split" in find(opened, "#summary").text
    find(opened, "#search").send_keys(f"track {TRACK}, part")
    assert len(texts(opened, ".open-car")) == 1
    path = "const done = arguments[0]; import('report/data').then(({cars, pathOf}) => done(cars.map(pathOf)))"
    lengths = [len(places) for places in opened.execute_async_script(path)]
    assert lengths == [3, 0] * 3


def test_frames_change_and_boxes_can_be_hidden(opened: Chrome) -> None:
    scene = show_scene(opened)
    find(opened, "#next-frame").click()
    chosen = find(opened, "#frame-choice").get_attribute("value")
    until(lambda: texts(opened, f"#frame-choice option[value='{chosen}']")[0] in scene.get_attribute("data-ready"))
    assert len(opened.find_elements("css selector", ".box-before")) > 12
    find(opened, "#show-before").click()
    assert opened.find_elements("css selector", ".box-before") == []
    assert len(opened.find_elements("css selector", ".box-after")) > 12
    assert len(opened.find_elements("css selector", ".box-truth")) > 12


def test_a_small_phone_is_wide_enough(opened: Chrome) -> None:
    set_viewport(opened, 320, 844)
    show_scene(opened)
    overflow = "return document.documentElement.scrollWidth - window.innerWidth"
    assert opened.execute_script(overflow) <= 0
    opened.execute_script("document.querySelector('.open-car').click()")
    opened.execute_script("document.getElementById('show-maps').click()")
    dialog = find(opened, "#car-dialog")
    assert opened.execute_script("return arguments[0].scrollWidth - arguments[0].clientWidth", dialog) <= 0
    assert opened.execute_script(overflow) <= 0


def test_the_table_of_cars_fits_a_desk_and_becomes_cards_on_a_phone(opened: Chrome) -> None:
    inside = "const box = document.querySelector('.scroller'); return box.scrollWidth - box.clientWidth"
    set_viewport(opened, 1600)
    assert opened.execute_script(inside) <= 0
    set_viewport(opened, 400, 844)
    assert opened.execute_script(inside) <= 0
    first = find(opened, "#car-rows tr")
    for title in ("IoU before", "IoU after", "IoU change", "Probably better"):
        cell = first.find_element("css selector", f"td[data-title='{title}']")
        assert cell.is_displayed()
        assert cell.rect["x"] + cell.rect["width"] <= 400
    from selenium.webdriver.support.ui import Select

    Select(find(opened, "#sort-choice")).select_by_visible_text("Distance [m]")
    distances = [float(text) for text in texts(opened, "td[data-title='Distance [m]']")]
    assert distances == sorted(distances, reverse=True)


def test_figures_that_became_worse_are_red(opened: Chrome) -> None:
    cells = opened.execute_script(
        """const cells = document.querySelectorAll("td[data-title='IoU change']");
        return [...cells].map((cell) => [cell.textContent, cell.className]);"""
    )
    known = [(float(text), tone) for text, tone in cells if text[-1].isdigit()]
    assert known
    for change, tone in known:
        if abs(change) > 0.01:
            assert ("good" if change > 0 else "bad") in tone.split()


def test_the_summary_says_which_cars_its_errors_are_of(opened: Chrome) -> None:
    tiles = opened.find_element("id", "summary").text
    said = opened.find_elements("id", "judged")
    number = int(tiles.split("BEV IoU, mean of ")[1].split()[0])
    assert f"of the {number} cars whose label is at least 25 px high" in said[0].text


def test_dark_and_light(opened: Chrome) -> None:
    def lightness(element: Any) -> float:
        return float(np.median(screenshot_of(element)))

    scene, summary = show_scene(opened), find(opened, "#summary")
    assert lightness(summary) > 200
    assert lightness(scene) > 200
    set_viewport(opened, 1280, dark=True)
    until(lambda: lightness(scene) < 60)
    assert lightness(summary) < 60


def test_without_webgl_the_rest_works(browser: Chrome, page: Path) -> None:
    source = "HTMLCanvasElement.prototype.getContext = () => null;"
    added = browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": source})
    try:
        set_viewport(browser, 1280)
        open_page(browser, page)
        scene = find(browser, "#scene")
        browser.execute_script("arguments[0].scrollIntoView()", scene)
        until(lambda: "No 3D view" in scene.text)
        find(browser, ".open-car").click()
        assert find(browser, "#car-dialog").is_displayed()
    finally:
        browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", added)
        console_problems(browser), requested_urls(browser)

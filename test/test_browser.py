# SPDX-License-Identifier: Apache-2.0
"""
Pages in a real browser: wide, phone, dark and print; zoom, hover, linked axes, clicks.

They need playwright (`pip install playwright`) and a Chromium of the system; without, they are
skipped.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
import shutil

from bag_fixtures import write_rosbag2
from flights import PARAMS, flight
import pytest
from test_window_headline import heavier, hung

from ctsid_ros.cli import main

pytestmark = pytest.mark.slow
CHROMIUM = next(filter(None, map(shutil.which, (
    'chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable'))), None)
AIRCRAFT = """
/**:
  ros__parameters:
    inputs: [aileron, elevator, throttle]
    outputs: [roll, pitch]
    aileron: {topic: /cub1/joy_serial_status, field: 'data[0]', unit: us}
    elevator: {topic: /cub1/joy_serial_status, field: 'data[1]', unit: us}
    throttle: {topic: /cub1/joy_serial_status, field: 'data[2]', unit: us}
    roll: {topic: /cub1/pose, field: 'euler(pose.orientation).roll', unit: rad}
    pitch: {topic: /cub1/pose, field: 'euler(pose.orientation).pitch', unit: rad}
"""
PATIENCE = 60_000   # ms, on a machine that has much else to do
# Draws all that is drawn only when it comes into view.
DRAW = """async () => {
  for (const div of document.querySelectorAll('.plot')) {
    if (!div.getBoundingClientRect().height) continue;
    div.scrollIntoView({block: 'center'});
    for (let k = 0; k < 600 && !div.querySelector('.nsewdrag'); k++)
      await new Promise((done) => setTimeout(done, 50));
  }
  window.scrollTo(0, 0);
}"""
SMALL = """() => [...document.querySelectorAll(
  'svg text, td, th, p, dt, dd, li, figcaption, .legend span, button')].filter((one) =>
    one.textContent.trim() && one.getBoundingClientRect().width > 0
    && parseFloat(getComputedStyle(one).fontSize) < 10.9).map((one) => one.textContent)"""
# Numbers along an axis that lie over each other, or over its title.
OVERLAP = """() => [...document.querySelectorAll('.plot')].flatMap((div) =>
  ['.xaxislayer-above', '.yaxislayer-above'].flatMap((layer) => {
    const boxes = [...div.querySelectorAll(layer + ' text')].filter((one) => one.textContent)
      .map((one) => [one.getBoundingClientRect(), one.textContent]);
    return boxes.flatMap(([a, s], i) => boxes.slice(i + 1).filter(([b]) =>
      a.left < b.right - 1 && b.left < a.right - 1 && a.top < b.bottom - 1 && b.top < a.bottom - 1)
      .map(([b, t]) => s + ' over ' + t));
  }))"""
# Titles in a drawing that lie under its bar of buttons.
COVERED = """() => [...document.querySelectorAll('.plot')].flatMap((div) => {
  const buttons = [...div.querySelectorAll('.modebar-group')].map(
    (one) => one.getBoundingClientRect());
  return [...div.querySelectorAll('.annotation text')].filter((text) => buttons.some((a) => {
    const b = text.getBoundingClientRect();
    return a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;
  })).map((one) => one.textContent);
})"""
FITS = """() => [...document.querySelectorAll('.plot .main-svg')].every((one) =>
  one.getBoundingClientRect().right <= document.body.getBoundingClientRect().left
    + 186 * 96 / 25.4 + 1)"""   # A4 less the margins
RANGE = "(at) => document.querySelectorAll('.plot')[at]._fullLayout.xaxis.range"


@pytest.fixture(scope='module')
def folder(tmp_path_factory) -> Path:
    """Reports of all kinds: whole, changed and rejected recordings, methods, models, batches."""
    place = tmp_path_factory.mktemp('browser')
    write_rosbag2(place / 'bag', flight(20.0))
    write_rosbag2(place / 'fleet/alpha/whole', flight(8.0))
    write_rosbag2(place / 'fleet/beta/hung', hung(flight(13.0)))
    write_rosbag2(place / 'changing', heavier(flight(30.0)))
    (place / 'params.yaml').write_text(PARAMS)
    given = ('--params', 'params.yaml', '--quiet')
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        assert main(['replay', 'bag', *given, '--out', 'windows']) == 0
        assert main(['compare', 'bag', *given, '--out', 'methods', '--orders', '1:3']) == 0
        assert main(['show', 'methods/gobf.json', 'methods/ct-pbsid.json', 'windows', '--quiet',
                     '--out', 'models']) == 0
        assert main(['identify', 'bag', *given, '--out', 'rejected', '--duration', '0.1']) == 3
        assert main(['replay', 'changing', *given, '--out', 'changed']) == 0
        if find_spec('distributed') and find_spec('pyarrow'):
            assert main(['batch', 'fleet', *given, '--out', 'batch', '--jobs', '1']) == 0
    return place


@pytest.fixture
def aircraft(folder, data_folder) -> Path:
    """The report of a real flight with three inputs and two outputs."""
    (folder / 'aircraft.yaml').write_text(AIRCRAFT)
    assert main(['identify', str(data_folder / 'cubs2'), '--params', str(folder / 'aircraft.yaml'),
                 '--start', '20', '--duration', '30', '--out', str(folder / 'aircraft'),
                 '--quiet']) in (0, 3)
    return folder


@pytest.fixture(scope='module')
def browser():
    if CHROMIUM is None:
        pytest.skip('no Chromium')
    api = pytest.importorskip('playwright.sync_api')
    pytest.importorskip('plotly')
    with api.sync_playwright() as started:
        running = started.chromium.launch(executable_path=CHROMIUM, args=['--no-sandbox'])
        yield running
        running.close()


@contextmanager
def opened(browser, path: Path, *, phone: bool = False, dark: bool = False,
           whole: bool = False, narrow: bool = False) -> Iterator:
    """Give a page, all of it drawn or not yet; its console has to say nothing."""
    context = browser.new_context(
        viewport={'width': 390 if phone or narrow else 1280, 'height': 844 if phone else 900},
        has_touch=phone, is_mobile=phone, color_scheme='dark' if dark else 'light', offline=True)
    page, said = context.new_page(), []
    page.set_default_timeout(PATIENCE)
    page.on('console', lambda message: said.append(message.text)
            if message.type in ('error', 'warning') else None)
    page.on('pageerror', lambda error: said.append(str(error)))
    page.on('request', lambda request: said.append(request.url)
            if not request.url.startswith(('file:', 'data:', 'blob:')) else None)
    page.goto(path.as_uri())
    if whole:
        page.evaluate(DRAW)
    yield page
    assert said == []
    context.close()


def drawn(page, selector: str, number: int = 0):
    """Return a drawing once it is there."""
    div = page.locator(selector).nth(number)
    div.scroll_into_view_if_needed()
    div.locator('.nsewdrag').first.wait_for(state='attached')
    return div


@pytest.mark.parametrize('name', ['windows', 'methods', 'models', 'rejected', 'changed', 'batch'])
def test_pages_fit_every_screen(browser, folder, name):
    if not (folder / name).exists():
        pytest.skip('no Dask')
    fits_every_screen(browser, folder / name / 'report.html')


def test_a_page_of_many_inputs_and_outputs_fits_every_screen(browser, aircraft):
    fits_every_screen(browser, aircraft / 'aircraft/report.html')


def fits_every_screen(browser, path: Path) -> None:
    for phone, narrow in ((False, False), (False, True), (True, True)):
        with opened(browser, path, phone=phone, dark=phone, whole=True, narrow=narrow) as page:
            width, inner = page.evaluate('[document.documentElement.scrollWidth, innerWidth]')
            assert width <= inner
            assert page.evaluate(SMALL) == []
            assert page.evaluate(OVERLAP) == []
            assert page.evaluate(COVERED) == []
            assert page.locator('.modebar-group').count() >= 2
            assert page.locator('.plot').count() >= 2


def test_figures_of_a_study_are_legible_on_a_phone_and_in_the_dark(browser, tmp_path):
    assert main(['study', 'hd-basis', '--out', str(tmp_path)]) == 0
    text = 11.0 / 10.0      # of a figure that is 920 wide its text is 10
    page_of = tmp_path / 'report.html'
    with opened(browser, page_of, phone=True, dark=True) as page:
        width, inner = page.evaluate('[document.documentElement.scrollWidth, innerWidth]')
        assert width <= inner
        assert page.locator('.picture img').first.bounding_box()['width'] >= 920 * text
        paint = "getComputedStyle(document.querySelector('.picture img')).filter"
        assert 'invert' in page.evaluate(paint)
        page.emulate_media(media='print')
        assert page.evaluate(paint) == 'none'
        assert page.locator('.picture img').first.bounding_box()['width'] < 720


@pytest.mark.parametrize(('name', 'word'), [('windows', 'GOOD'), ('changed', 'CHANGED'),
                                            ('rejected', 'REJECT'), ('batch', 'PARTLY')])
def test_the_word_comes_first_in_its_colour(browser, folder, name, word):
    if not (folder / name).exists():
        pytest.skip('no Dask')
    with opened(browser, folder / name / 'report.html', phone=True) as page:
        grade = page.locator('header .grade')
        assert grade.inner_text() == word
        assert grade.bounding_box()['y'] < 200
        paint = page.evaluate("getComputedStyle(document.querySelector('header .grade')).color")
        assert paint == {'GOOD': 'rgb(21, 128, 61)', 'REJECT': 'rgb(207, 34, 46)'}.get(
            word, 'rgb(191, 135, 0)')
        assert page.locator('header pre').inner_text().startswith('ctsid ')


def test_pages_follow_light_dark_and_print(browser, folder):
    paint = "getComputedStyle(document.querySelector('.plot .gridlayer path')).stroke"
    back = 'getComputedStyle(document.body).backgroundColor'
    with opened(browser, folder / 'rejected/report.html') as page:
        drawn(page, '.plot')
        light = page.evaluate(f'[{paint}, {back}]')
        page.emulate_media(color_scheme='dark')
        page.wait_for_function(f'{paint} !== "{light[0]}"')
        assert page.evaluate(back) != light[1]
        page.emulate_media(media='print')
        page.wait_for_function(f'{back} === "rgb(255, 255, 255)"')
        page.evaluate("dispatchEvent(new Event('beforeprint'))")
        assert page.evaluate("[...document.querySelectorAll('details')].every((d) => d.open)")
        page.wait_for_function(FITS)
        assert len(page.pdf(format='A4', print_background=True)) > 20_000


def test_zoom_and_linked_axes(browser, folder):
    with opened(browser, folder / 'methods/report.html') as page:
        linked = page.evaluate("""[...document.querySelectorAll('.plot')].map((d, k) =>
            [d.dataset.link, k]).filter(([link]) => link === 'time').map(([, k]) => k)""")
        assert len(linked) >= 2        # signals, and the sampling of each
        first, *others = linked
        for other in others:
            drawn(page, '.plot', other)
        div = drawn(page, '.plot', first)
        before = page.evaluate(RANGE, first)
        box = div.locator('.nsewdrag').first.bounding_box()
        page.mouse.move(box['x'] + 0.3 * box['width'], box['y'] + 0.5 * box['height'])
        page.mouse.down()
        page.mouse.move(box['x'] + 0.6 * box['width'], box['y'] + 0.5 * box['height'], steps=5)
        page.mouse.up()
        page.wait_for_function(f'({RANGE})({first})[0] > {before[0]} + 1')
        low, high = page.evaluate(RANGE, first)
        assert high - low == pytest.approx(0.3 * (before[1] - before[0]), rel=0.05)
        for other in others:
            page.wait_for_function(f'Math.abs(({RANGE})({other})[0] - {low}) < 1e-6')
        div.locator('.nsewdrag').first.dblclick()
        page.wait_for_function(f'({RANGE})({others[0]})[0] < {low} - 1')


def test_hover_says_the_numbers_and_the_legend_hides(browser, folder):
    with opened(browser, folder / 'methods/report.html') as page:
        div = drawn(page, '.plot[data-link=frequency]')
        box = div.locator('.nsewdrag').first.bounding_box()
        page.mouse.move(box['x'] + 0.4 * box['width'], box['y'] + 0.4 * box['height'])
        page.mouse.move(box['x'] + 0.41 * box['width'], box['y'] + 0.4 * box['height'])
        page.wait_for_function("document.querySelectorAll('.hoverlayer text').length >= 3")
        assert 'gobf' in ' '.join(page.locator('.hoverlayer text').all_text_contents())
        key = page.locator('figure:has(.plot[data-link=frequency]) .key[data-name=gobf]').first
        key.click()
        shown = """[...document.querySelector('.plot[data-link=frequency]').data].filter(
            (t) => t.meta === 'gobf').map((t) => t.visible)"""
        assert set(page.evaluate(shown)) == {False}
        key.click()
        assert set(page.evaluate(shown)) == {True}


@pytest.mark.parametrize(('name', 'first', 'then'), [
    ('methods', 'Order 2 (chosen)', 'Order 3'), ('windows', 'Window ', 'Window 2 of ')])
def test_a_click_chooses_the_order_or_the_window(browser, folder, name, first, then):
    with opened(browser, folder / name / 'report.html') as page:
        title = page.locator('#explorer strong')
        assert title.inner_text().startswith(first)
        drawn(page, '.plot[data-picks]')
        at = page.evaluate(f"""() => {{
            const one = JSON.parse(document.getElementById('series').textContent).windows.find(
                (w) => w.title.startsWith('{then}'));
            const div = document.querySelector('.plot[data-picks]');
            const axis = div._fullLayout.xaxis;
            const box = div.getBoundingClientRect();
            return [box.left + axis._offset + axis.d2p(one.at), box.top + 80]; }}""")
        page.mouse.move(*at)
        page.wait_for_timeout(300)
        page.mouse.click(*at)
        page.wait_for_function(
            f"document.querySelector('#explorer strong').textContent.startsWith('{then}')")
        before = title.inner_text()
        page.locator('#explorer button').first.click()
        assert title.inner_text() != before
        assert page.locator('#explorer .plot').count() >= 3
        drawn(page, '#explorer .plot')
        assert page.locator('#explorer .verdict').inner_text().split('.')[0] in (
            'GOOD', 'WEAK', 'REJECT')

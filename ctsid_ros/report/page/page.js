'use strict';
(async function () {
  // The library of the drawings is most of the page: it is kept as base64 of gzip.
  async function unpack(text) {
    const bytes = Uint8Array.from(atob(text), (char) => char.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip'));
    const script = document.createElement('script');
    script.textContent = await new Response(stream).text();
    document.head.append(script);
  }
  try {
    await unpack(document.getElementById('library').textContent);
  } catch (error) {
    const words = document.createElement('footer');
    words.textContent = `The drawings need a browser of 2023 or later (${error.message}).`;
    document.body.append(words);
    throw error;
  }

  const figures = JSON.parse(document.getElementById('figures').textContent);
  const { frames, windows } = JSON.parse(document.getElementById('series').textContent);
  const touch = matchMedia('(pointer: coarse)').matches;
  const config = { responsive: true, displaylogo: false, scrollZoom: false,
    displayModeBar: touch ? true : 'hover',
    modeBarButtons: [['toImage'], touch ? ['zoomIn2d', 'zoomOut2d', 'pan2d', 'resetScale2d']
      : ['zoom2d', 'pan2d', 'zoomIn2d', 'zoomOut2d', 'resetScale2d']] };
  let busy = false;

  // '--c1/0.2' is the page's colour 1, a fifth of it.
  function paint(value, style) {
    if (typeof value === 'string' && value.startsWith('--')) {
      const [name, share] = value.split('/');
      const color = style.getPropertyValue(name).trim();
      if (!share) return color;
      const [r, g, b] = [1, 3, 5].map((k) => parseInt(color.slice(k, k + 2), 16));
      return `rgba(${r},${g},${b},${share})`;
    }
    if (Array.isArray(value)) {
      return typeof value[0] === 'number' ? value : value.map((entry) => paint(entry, style));
    }
    if (value && typeof value === 'object') {
      return Object.fromEntries(Object.entries(value).map(([k, v]) => [k, paint(v, style)]));
    }
    return value;
  }

  function draw(div) {
    const style = getComputedStyle(document.documentElement);
    const fig = paint(div.figure || figures[div.dataset.number], style);
    div.style.height = `${fig.layout.height}px`;
    const range = div.layout && div.layout.xaxis && !div.layout.xaxis.autorange && div.layout.xaxis.range;
    if (range && div.dataset.link) fig.layout.xaxis.range = range.slice();
    if (!div.layout && linked[div.dataset.link]) fig.layout.xaxis.range = linked[div.dataset.link].slice();
    // On a finger's screen a drag scrolls the page; zoom is in the bar of each drawing.
    if (touch) fig.layout.dragmode = false;
    const first = !div.layout;
    return Plotly.react(div, fig.data, fig.layout, config).then(() => {
      if (!first) return;
      div.on('plotly_relayout', (change) => follow(div, change));
      if (div.dataset.picks) div.on('plotly_click', (event) => pick(event.points));
    });
  }

  // Drawings with the same link show the same interval.
  const linked = {};
  function follow(div, change) {
    const link = div.dataset.link;
    if (busy || !link) return;
    let update = null;
    if (change['xaxis.autorange']) {
      update = { 'xaxis.autorange': true };
      delete linked[link];
    } else if ('xaxis.range[0]' in change || 'xaxis.range' in change) {
      const range = change['xaxis.range'] || [change['xaxis.range[0]'], change['xaxis.range[1]']];
      linked[link] = range.slice();
      update = { 'xaxis.range': range };
    }
    if (!update) return;
    busy = true;
    const others = [...document.querySelectorAll('.plot')].filter(
      (other) => other !== div && other.layout && other.dataset.link === link);
    Promise.all(others.map((other) => Plotly.relayout(other, update))).finally(() => { busy = false; });
  }

  // Only what comes into view is drawn; all before printing.
  const seen = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (entry.isIntersecting) {
        seen.unobserve(entry.target);
        draw(entry.target);
      }
    }
  }, { rootMargin: '200px' });
  const plots = () => [...document.querySelectorAll('.plot')];
  plots().forEach((div) => seen.observe(div));

  function again(all) {
    return Promise.all(plots().filter((div) => all || div.layout).map((div) => Promise.resolve(draw(div))
      .then(() => div.getBoundingClientRect().width && Plotly.Plots.resize(div))));
  }
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => again(false));
  matchMedia('print').addEventListener('change', () => again(true));
  addEventListener('beforeprint', () => {
    document.querySelectorAll('details').forEach((one) => { one.open = true; });
    again(true);
  });
  addEventListener('afterprint', () => again(false));
  document.querySelectorAll('details').forEach((one) => one.addEventListener('toggle', () => {
    one.querySelectorAll('.plot').forEach((div) => { if (div.layout) Plotly.Plots.resize(div); });
  }));

  // A word of a legend shows and hides what it names.
  function legends(root) {
    root.querySelectorAll('.key').forEach((key) => {
      const div = key.closest('figure').querySelector('.plot');
      if (!div) return;
      key.setAttribute('role', 'button');
      key.tabIndex = 0;
      const toggle = () => {
        key.classList.toggle('off');
        const shown = !key.classList.contains('off');
        const rows = div.data.map((trace, k) => [trace.meta, k])
          .filter(([name]) => name === key.dataset.name).map(([, k]) => k);
        if (rows.length) Plotly.restyle(div, { visible: shown }, rows);
      };
      key.addEventListener('click', toggle);
      key.addEventListener('keydown', (event) => { if (event.key === 'Enter') toggle(); });
    });
  }
  legends(document);

  // One window of a series.
  const explorer = document.getElementById('explorer');
  let shown = 0;

  function pick(points) {
    const at = points[0].x;
    let best = 0;
    windows.forEach((one, k) => { if (Math.abs(one.at - at) < Math.abs(windows[best].at - at)) best = k; });
    show(best);
    explorer.scrollIntoView({ behavior: 'smooth', block: 'nearest' });
  }

  function show(number) {
    shown = Math.min(Math.max(number, 0), windows.length - 1);
    const one = windows[shown];
    explorer.querySelector('strong').textContent = one.title;
    const verdict = explorer.querySelector('.verdict');
    verdict.className = `verdict ${one.grade}`;
    verdict.textContent = `${one.grade}. ${one.reason}`;
    const body = explorer.querySelector('tbody');
    body.replaceChildren(...one.facts.map(([name, value]) => {
      const row = document.createElement('tr');
      const head = document.createElement('th');
      const cell = document.createElement('td');
      head.textContent = name;
      cell.textContent = value;
      row.append(head, cell);
      return row;
    }));
    const gallery = explorer.querySelector('.gallery');
    gallery.style.display = one.figures.length ? '' : 'none';
    one.figures.forEach((given, k) => {
      let figure = gallery.children[k];
      if (!figure) {
        figure = document.createElement('figure');
        const title = document.createElement('h3');
        const div = document.createElement('div');
        div.className = 'plot';
        div.dataset.link = '';
        figure.append(title, div);
        gallery.append(figure);
      }
      figure.style.display = '';
      figure.querySelector('h3').textContent = given.title;
      const div = figure.querySelector('.plot');
      div.figure = filled(given);
      if (!div.layout) div.style.height = `${div.figure.layout.height}px`;
      if (div.layout) draw(div); else seen.observe(div);
    });
    [...gallery.children].slice(one.figures.length).forEach((rest) => { rest.style.display = 'none'; });
  }

  // What the drawings of all windows share is kept once.
  function filled(given) {
    const figure = JSON.parse(JSON.stringify(frames[given.frame]));
    figure.data.forEach((trace, k) => {
      const own = given.y[k];
      if (own) trace.y = own;
      if (given.x && given.x[k]) trace.x = given.x[k];
      trace.visible = Boolean(own);
    });
    return figure;
  }

  if (explorer && windows.length) {
    explorer.querySelectorAll('button').forEach((button) => button.addEventListener(
      'click', () => show(shown + Number(button.dataset.by))));
    show(Number(explorer.dataset.first));
  }
}());

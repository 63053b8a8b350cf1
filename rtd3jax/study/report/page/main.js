// Builds the page: colours, texts about the study, and redrawing.

function colours() {
  const rules = (name) => DATA.agents.map((agent, index) => `--a${index}: ${agent[name]};`).join(' ');
  const text = `:root { ${rules('colour')} } @media (prefers-color-scheme: dark) { :root { ${rules('dark')} } }`;
  document.head.append(el('style', {}, text));
}

function lede() {
  const { cells, seeds } = DATA.study;
  const counts = Object.entries(DATA.status).map(([name, count]) => `${count.toLocaleString('en')} ${name}`).join(', ');
  byId('lede').textContent = `${plural(cells, 'cell')} × ${plural(seeds.length, 'seed')}` + (counts ? `; lanes: ${counts}.` : '.');
  const notes = byId('notes');
  notes.hidden = !DATA.notes.length;
  notes.replaceChildren(...DATA.notes.map((note) => el('li', {}, note)));
  byId('footer').textContent = `Written ${DATA.written} by rtd3jax ${DATA.rtd3jax}.`;
}

const textOf = (value) => (value === null ? DASH : Number.isInteger(value) ? value.toLocaleString('en') : typeof value === 'number' ? compact(value) : String(value));

function drawStudy() {
  const { settings } = DATA.study;
  const rows = settings.map(({ name, values, about }) => el('tr', {}, el('td', {}, name),
    el('td', {}, values.map(textOf).join('; ')), el('td', {}, about)));
  const configuration = el('div', {}, el('h3', {}, 'Configuration'),
    el('div', { class: 'scroll', tabindex: 0, role: 'region', 'aria-label': 'Configuration' },
      el('table', { class: 'data wrap' }, el('thead', {}, el('tr', {}, ['setting', 'value', 'meaning'].map((name) => el('th', { scope: 'col' }, name)))), el('tbody', {}, rows))));
  const parts = [configuration, el('div', {}, el('h3', {}, 'Time'), timing(), el('h3', {}, 'Made with'), madeWith(), ...troubles())];
  byId('study').querySelector('.body').replaceChildren(el('div', { class: 'columns' }, parts));
}

const pairs = (list) => el('table', { class: 'data wrap' }, el('tbody', {}, list.map(([name, text]) => el('tr', {}, el('td', {}, name), el('td', {}, text)))));

function timing() {
  const time = DATA.timing;
  if (!time) return el('p', { class: 'missing' }, 'The run has no log with times.');
  if (time.shards !== undefined) return pairs([['environment steps', compact(time.steps)], time.shards ? ['shards', `${time.shards}, each with its own clock`] : ['cluster', 'each task with its own clock']]);
  return pairs([['environment steps', compact(time.steps)], ['total time', duration(time.seconds)],
    ['sessions', String(time.sessions)], ['steps per second', time.steps_per_second ? compact(Math.round(time.steps_per_second)) : DASH]]);
}

function madeWith() {
  const { versions = {}, ...others } = DATA.made_with;
  const list = [...Object.entries(others), ...Object.entries(versions)].map(([name, value]) => [name, String(value)]);
  return list.length ? pairs(list) : el('p', { class: 'missing' }, 'config.json does not contain this.');
}

function troubles() {
  if (!DATA.troubles.length) return [];
  const rows = DATA.troubles.map((row) => [`${row.env}, ${row.disturbance}, ${row.algorithm}, history ${row.history_length}, seed ${row.seed}`,
    `${row.status} at step ${row.step.toLocaleString('en')}${row.reason ? `: ${row.reason}` : ''}`]);
  return [el('h3', {}, 'Lanes that run, were interrupted, were lost or failed'), pairs(rows)];
}

function redraw() {
  tip.hide();
  drawCurves();
  drawLearning();
  drawFinals();
  drawTable();
  drawTransfer();
  drawRobustness();
}

colours();
lede();
startFilters(redraw);
startLearning();
redraw();
startPlayback();
drawStudy();
// The text of a tap stays until the next tap, which is seen here before the plot that shows another.
addEventListener('pointerdown', () => tip.hide(), true);
addEventListener('keydown', (event) => { if (event.key === 'Escape') tip.hide(); });
let settled = null;
let width = document.documentElement.clientWidth;
addEventListener('resize', () => {
  // The address bar of a phone only changes the height.
  if (document.documentElement.clientWidth === width) return;
  width = document.documentElement.clientWidth;
  clearTimeout(settled);
  settled = setTimeout(() => { redraw(); if (player.rebuild) player.rebuild(); }, 120);
});

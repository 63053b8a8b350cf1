// Final returns: for each disturbance, a row per agent and length; dots are seeds.

function drawFinals() {
  const section = byId('finals');
  section.querySelector('.about').textContent =
    `The trained policies over ${plural(DATA.study.episodes, 'episode')} per seed: small dots are seeds, ` +
    'the large one is their interquartile mean with its 95 % bootstrap interval.';
  const body = section.querySelector('.body');
  const panels = DATA.environments
    .map((environment, index) => ({ environment, cells: shownCells().filter((cell) => cell.environment === index && cell.final[state.measure]) }))
    .filter(({ cells }) => cells.length)
    .map((panel) => ({ ...panel, range: finalRange(panel) }));
  section.querySelector('.legend').replaceChildren(...referenceItems(panels));
  if (!panels.length) {
    body.replaceChildren(el('p', { class: 'missing' }, 'No selected lane has ended yet.'));
    return;
  }
  panelGrid(body, panels, 430, finalPanel);
}

function finalRange({ environment, cells }) {
  const finals = cells.map((cell) => cell.final[state.measure]);
  const values = finals.flatMap((final) => [...final.values, final.low, final.high]);
  return limits(values, referencesOf(environment, state.measure));
}

function finalPanel({ environment, cells, range }, width) {
  const rows = [...cells].sort((a, b) => a.agent - b.agent || a.length - b.length);
  const names = rows.map(cellName);
  const left = Math.min(width * 0.45, 18 + 6.3 * Math.max(...names.map((name) => name.length)));
  const line = 24;
  const height = rows.length * line + 34 + 13 * range.far.length;
  const right = width - 16;
  const x = scale(range.low, range.high, left, right);
  const label = `Final returns, ${environmentName(environment)}`;
  const svg = draw('svg', { class: 'plot', width, height, viewBox: `0 0 ${width} ${height}`, role: 'img', 'aria-label': label });
  const marks = ticks(range.low, range.high, Math.max(2, Math.floor((right - left) / 80)));
  const bottom = rows.length * line + 8;
  for (const value of marks.values) {
    svg.append(draw('line', { class: 'grid', x1: x(value), x2: x(value), y1: 4, y2: bottom }));
    svg.append(draw('text', { x: x(value), y: bottom + 15, 'text-anchor': 'middle' }, fixed(value, marks.decimals)));
  }
  for (const reference of range.near) {
    const at = x(reference.value);
    svg.append(draw('line', { class: 'reference', x1: at, x2: at, y1: 4, y2: bottom, 'stroke-dasharray': dashOf(reference) },
      draw('title', {}, `${reference.name} ${fixed(reference.value, decimalsFor([range.low, range.high]))}`)));
  }
  rows.forEach((cell, k) => svg.append(finalRow(cell, names[k], 8 + line * (k + 0.5), x, left, right)));
  range.far.forEach((reference, k) => {
    svg.append(draw('text', { class: 'note', x: right, y: bottom + 28 + 13 * k, 'text-anchor': 'end' }, farWords(reference, marks.decimals)));
  });
  return el('figure', {}, el('figcaption', {}, environmentName(environment)), svg);
}

function finalRow(cell, name, y, x, left, right) {
  const final = cell.final[state.measure];
  const group = draw('g', { style: `color: var(--a${cell.agent})` });
  group.append(draw('text', { class: 'strong', x: left - 9, y: y + 4, 'text-anchor': 'end' }, name));
  for (const value of final.values) group.append(draw('circle', { cx: x(value), cy: y, r: 2.2, fill: 'currentColor', opacity: 0.45 }));
  if (finite(final.low)) group.append(draw('line', { x1: x(final.low), x2: x(final.high), y1: y, y2: y, stroke: 'currentColor', 'stroke-width': 2 }));
  if (finite(final.iqm)) group.append(draw('circle', { cx: x(final.iqm), cy: y, r: 4.6, fill: 'currentColor' }));
  const hit = draw('rect', { x: left, y: y - 11, width: right - left, height: 22, fill: 'transparent' });
  const decimals = decimalsFor([final.iqm]);
  const show = (event) => {
    const frame = hit.ownerSVGElement.getBoundingClientRect();
    const spread = finite(final.low) ? ` [${fixed(final.low, decimals)}, ${fixed(final.high, decimals)}]` : '';
    const lost = final.lost ? `, ${final.lost} lost` : '';
    tip.show(hit.ownerSVGElement, event.clientX - frame.left, y, el('strong', {}, name),
      `${fixed(final.iqm, decimals)}${spread}, ${plural(final.n, 'seed')}${lost}`);
  };
  readByPointer(hit, show, () => tip.hide());
  group.append(hit);
  return group;
}

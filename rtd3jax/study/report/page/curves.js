// Learning curves: a panel for each disturbance and history length, with a line and a band per agent.

function curvePanels() {
  const panels = [];
  DATA.environments.forEach((environment, index) => {
    const cells = shownCells().filter((cell) => cell.environment === index);
    if (!cells.length) return;
    const lengths = lengthsOf(cells);
    const references = referencesOf(environment, state.measure);
    const curves = cells.map((cell) => cell.curves[state.measure]).filter(Boolean);
    // The same range for all lengths of an environment, so that its panels can be compared. Early returns
    // may be a hundred times lower than late returns: the lowest tenth of all points may be cut off.
    const bottoms = curves.map((curve) => curve.low.map((low, k) => (finite(low) ? low : curve.iqm[k])).filter(finite));
    const lows = bottoms.flat();
    // No curve ends below the panel, however few of the points are its own.
    const ends = bottoms.filter((bottom) => bottom.length).map((bottom) => bottom.at(-1));
    const floor = lowest([quantile(lows, 0.1), ...ends]);
    const kept = curves.flatMap((curve) => [...curve.low, ...curve.high, ...curve.iqm]).filter((value) => value >= floor);
    const range = { ...limits(kept, references), cut: lowest(lows) < floor };
    for (const length of lengths.length ? lengths : [0]) {
      const here = cells.filter((cell) => cell.length === 0 || cell.length === length);
      panels.push({ environment, length, cells: here, range });
    }
  });
  return panels;
}

function quantile(values, share) {
  const sorted = values.filter(finite).sort((a, b) => a - b);
  return sorted.length ? sorted[Math.floor(share * (sorted.length - 1))] : -Infinity;
}

let clips = 0;

function drawCurves() {
  const section = byId('curves');
  const panels = curvePanels();
  section.querySelector('.about').textContent =
    'Evaluation returns over environment steps: the interquartile mean over the seeds, with ' +
    'the 95 % bootstrap interval of this mean as a band. To read values, point at a curve, or focus a ' +
    'panel and use the arrow keys.' + (panels.some(({ range }) => range.cut) ? ' Early returns that are far below the others are cut off.' : '');
  section.querySelector('.legend').replaceChildren(...legendItems(panels));
  const body = section.querySelector('.body');
  if (!panels.length) {
    body.replaceChildren(el('p', { class: 'missing' }, 'The filter above selects nothing.'));
    return;
  }
  panelGrid(body, panels, 330, curvePanel);
}

function legendItems(panels) {
  const agents = [...new Set(panels.flatMap((panel) => panel.cells.map((cell) => cell.agent)))];
  const items = agents.sort((a, b) => a - b).map((agent) => el('span', {}, swatch(agent), DATA.agents[agent].name));
  return [...items, ...referenceItems(panels)];
}

function referenceItems(panels) {
  const names = new Map();
  for (const { range } of panels) for (const reference of range.near) names.set(reference.name, dashOf(reference));
  return [...names].map(([name, dash]) => {
    const line = draw('line', { x1: 0, x2: 26, y1: 5, y2: 5, class: 'reference', 'stroke-dasharray': dash });
    return el('span', {}, draw('svg', { width: 26, height: 10, 'aria-hidden': 'true' }, line), name);
  });
}

const stepWords = (step) => `step ${step.toLocaleString('en')}`;

function curvePanel({ environment, length, cells, range, title: given, under, at = stepWords }, width) {
  const title = given ?? [environmentName(environment), length ? lengthName(length) : null].filter(Boolean).join(', ');
  const drawn = cells.filter((cell) => cell.curves[state.measure]);
  const figure = el('figure', {}, el('figcaption', {}, title));
  if (!drawn.length) {
    figure.append(el('p', { class: 'missing' }, 'no evaluation yet'));
    return figure;
  }
  const height = 230;
  const last = highest(drawn.map((cell) => highest(cell.curves[state.measure].steps)));
  // Steps begin at zero and have long numbers; the values of a quantity begin anywhere.
  const first = under ? lowest(drawn.flatMap((cell) => cell.curves[state.measure].steps)) : 0;
  const plot = axes({ width, height, x: [first, last], every: under ? 50 : 90, y: [range.low, range.high], label: title });
  for (const reference of range.near) {
    const y = plot.y(reference.value);
    plot.svg.append(draw('line', { class: 'reference', x1: plot.left, x2: plot.right, y1: y, y2: y, 'stroke-dasharray': dashOf(reference) }));
  }
  const clip = `clip-${(clips += 1)}`;
  plot.svg.append(draw('clipPath', { id: clip }, draw('rect', { x: plot.left, y: plot.top, width: plot.right - plot.left, height: plot.bottom - plot.top })));
  plot.svg.append(draw('g', { 'clip-path': `url(#${clip})` }, drawn.map((cell) => curveLine(cell, plot))));
  range.far.forEach((reference, k) => {
    const words = farWords(reference, plot.decimals);
    const y = reference.above ? plot.top + 12 + 13 * k : plot.bottom - 5 - 13 * k;
    plot.svg.append(draw('text', { class: 'note', x: plot.right - 4, y, 'text-anchor': 'end' }, words));
  });
  readable(plot, drawn, title, at);
  figure.append(plot.svg);
  if (under) figure.append(el('p', { class: 'quantity' }, under));
  return figure;
}

function curveLine(cell, plot) {
  const curve = cell.curves[state.measure];
  const points = curve.steps.map((step, k) => ({ x: plot.x(step), k })).filter(({ k }) => finite(curve.iqm[k]));
  const path = (values, list) => list.map(({ x, k }) => `${x.toFixed(1)},${plot.y(values[k]).toFixed(1)}`).join(' ');
  const group = draw('g', { class: 'agent-line', style: `color: var(--a${cell.agent})`, 'data-agent': DATA.agents[cell.agent].name });
  const banded = points.filter(({ k }) => finite(curve.low[k]) && finite(curve.high[k]));
  if (banded.length > 1) {
    const back = [...banded].reverse();
    group.append(draw('polygon', { class: 'band', points: `${path(curve.high, banded)} ${path(curve.low, back)}` }));
  }
  if (points.length > 1) group.append(draw('polyline', { class: 'line', points: path(curve.iqm, points) }));
  else points.forEach(({ x, k }) => group.append(draw('circle', { cx: x, cy: plot.y(curve.iqm[k]), r: 3, fill: 'currentColor' })));
  return group;
}

// Hover, touch and arrow keys: the values at the nearest point; `at` names the point.
function readable(plot, cells, title, words) {
  const steps = [...new Set(cells.flatMap((cell) => cell.curves[state.measure].steps))].sort((a, b) => a - b);
  const cross = draw('line', { class: 'cross', y1: plot.top, y2: plot.bottom, visibility: 'hidden' });
  plot.svg.append(cross);
  let at = steps.length - 1;
  const show = (index) => {
    at = Math.max(0, Math.min(steps.length - 1, index));
    const x = plot.x(steps[at]);
    fill(cross, { x1: x, x2: x, visibility: 'visible' });
    const rows = cells
      .map((cell) => ({ cell, curve: cell.curves[state.measure], k: cell.curves[state.measure].steps.indexOf(steps[at]) }))
      .filter(({ k, curve }) => k >= 0 && finite(curve.iqm[k]))
      .sort((a, b) => b.curve.iqm[b.k] - a.curve.iqm[a.k])
      .map(({ cell, curve, k }) => {
        const of = curve.seeds[k] < cell.seeds ? ` (${curve.seeds[k]} of ${cell.seeds} seeds)` : '';
        const spread = finite(curve.low[k]) ? `${fixed(curve.low[k], plot.decimals)} to ${fixed(curve.high[k], plot.decimals)}` : '';
        return el('tr', {}, el('td', {}, swatch(cell.agent), ` ${DATA.agents[cell.agent].name}${of}`),
          el('td', { class: 'number' }, fixed(curve.iqm[k], plot.decimals)), el('td', { class: 'number' }, spread));
      });
    tip.show(plot.svg, x, plot.top, el('strong', {}, `${title}: ${words(steps[at])}`), el('table', {}, el('tbody', {}, rows)));
  };
  const hide = () => { cross.setAttribute('visibility', 'hidden'); tip.hide(plot.svg); };
  const nearest = (x) => steps.reduce((best, step, k) => (Math.abs(plot.x(step) - x) < Math.abs(plot.x(steps[best]) - x) ? k : best), 0);
  readByPointer(plot.svg, (event) => show(nearest(event.clientX - plot.svg.getBoundingClientRect().left)), hide);
  fill(plot.svg, {
    tabindex: 0,
    onfocus: () => { if (plot.svg.matches(':focus-visible')) show(at); },
    onblur: hide,
    onkeydown: (event) => {
      const move = { ArrowLeft: -1, ArrowRight: 1, Home: -steps.length, End: steps.length }[event.key];
      if (event.key === 'Escape') hide();
      if (move === undefined) return;
      event.preventDefault();
      show(at + move);
    },
  });
}

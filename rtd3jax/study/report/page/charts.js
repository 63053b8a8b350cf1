// Scales, axes, and the text next to the pointer.

function ticks(low, high, count) {
  const rough = (high - low) / Math.max(1, count);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 2.5, 5, 10].find((factor) => factor * power >= rough * 0.999);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + step * 1e-9; k++) found.push(k * step);
  return { values: found, decimals: Math.max(0, -Math.floor(Math.log10(step) + 1e-9) + (step / power === 2.5 ? 1 : 0)) };
}

const scale = (low, high, from, to) => (value) => from + ((value - low) / (high - low || 1)) * (to - from);

// Limits around values, and the references that are near enough for a line. A reference whose distance
// exceeds the range of the values is named at the edge, because its line would compress the values.
function limits(values, references) {
  let kept = values.filter(finite);
  if (!kept.length) kept = references.map((r) => r.value);
  if (!kept.length) kept = [0];
  let low = lowest(kept);
  let high = highest(kept);
  const span = high - low || Math.max(Math.abs(high), 1) * 0.1;
  const isNear = (r) => r.value >= low - span && r.value <= high + span;
  const near = references.filter(isNear);
  const far = references.filter((r) => !isNear(r)).map((r) => ({ ...r, above: r.value > high }));
  low = Math.min(low, ...near.map((r) => r.value));
  high = Math.max(high, ...near.map((r) => r.value));
  const margin = 0.06 * (high - low || span);
  return { low: low - margin, high: high + margin, near, far };
}

const DASHES = { random: '2 3', constant: '8 4', ceiling: null };
const OTHER_DASHES = ['9 3 2 3', '5 3', '9 3 2 3 2 3', '14 4'];

function referencesOf(environment, measure) {
  const found = environment.references.map((r) => ({ name: r.name, value: r[measure] }));
  const best = environment.ceiling;
  // Under a disturbed reward, only the ceiling of the return of the true state is known.
  if (best && finite(best.mean) && (best.measure === 'return' || best.measure === measure)) {
    const name = best.kind === 'exact' ? 'ceiling' : 'ceiling (upper bound)';
    found.push({ name, value: best.mean, ceiling: true });
  }
  return found.filter((r) => finite(r.value));
}

// Only a ceiling is a solid line; policies that DASHES does not name get patterns in their order.
function dashOf(reference) {
  if (reference.ceiling) return DASHES.ceiling;
  if (reference.name in DASHES) return DASHES[reference.name];
  const names = DATA.environments.flatMap((environment) => environment.references.map((r) => r.name));
  const others = [...new Set(names)].filter((name) => !(name in DASHES));
  return OTHER_DASHES[others.indexOf(reference.name) % OTHER_DASHES.length];
}

// A value outside the axis is large, so the decimals of the axis are not needed.
function farWords(reference, decimals) {
  const large = Math.abs(reference.value) >= 10;
  return `${reference.above ? '\u2191' : '\u2193'} ${reference.name} ${fixed(reference.value, large ? 0 : decimals)}`;
}

const tip = {
  anchor: null,
  show(anchor, x, y, ...content) {
    const box = byId('tip');
    tip.anchor = anchor;
    box.replaceChildren(...content.flat());
    box.hidden = false;
    const frame = anchor.getBoundingClientRect();
    const width = document.documentElement.clientWidth;
    const left = frame.left + x + 14;
    const flipped = left + box.offsetWidth > width - 8 ? frame.left + x - box.offsetWidth - 14 : left;
    box.style.left = `${Math.max(8, flipped) + window.scrollX}px`;
    box.style.top = `${frame.top + y + 10 + window.scrollY}px`;
  },
  // A plot only hides its own text: the one that is left loses the focus after the next one was tapped.
  hide(anchor = tip.anchor) { if (anchor === tip.anchor) byId('tip').hidden = true; },
};

// A mouse reads a plot by moving. A finger reads it by a tap, whose text stays when the finger is lifted.
function readByPointer(node, show, hide) {
  fill(node, {
    onpointerdown: show,
    onpointermove: show,
    onpointercancel: hide,
    onpointerleave: (event) => { if (event.pointerType !== 'touch') hide(); },
  });
}

const swatch = (agent) => el('span', { class: 'swatch', style: `color: var(--a${agent})`, 'aria-hidden': 'true' });

// The width of the numbers on the left of a plot, in pixels.
const marginFor = (texts) => 14 + 6.4 * highest([0, ...texts.map((text) => text.length)]);

// The frame of a plot: gridlines and numbers, one on the x axis for about `every` pixels. x is environment
// steps or a strength, y is a return.
function axes({ width, height, x, y, label, every = 90 }) {
  const marks = ticks(y[0], y[1], 4);
  const texts = marks.values.map((value) => fixed(value, marks.decimals));
  const left = marginFor(texts);
  const frame = { left, right: width - 12, top: 8, bottom: height - 24, decimals: decimalsFor(y) };
  frame.x = scale(x[0], x[1], frame.left, frame.right);
  frame.y = scale(y[0], y[1], frame.bottom, frame.top);
  const svg = draw('svg', { class: 'plot', width, height, viewBox: `0 0 ${width} ${height}`, role: 'img', 'aria-label': label });
  marks.values.forEach((value, k) => {
    const at = frame.y(value);
    svg.append(draw('line', { class: 'grid', x1: frame.left, x2: frame.right, y1: at, y2: at }));
    svg.append(draw('text', { x: frame.left - 6, y: at + 3.8, 'text-anchor': 'end' }, texts[k]));
  });
  for (const value of ticks(x[0], x[1] > x[0] ? x[1] : x[0] + 1, Math.max(2, Math.floor(width / every))).values) {
    const at = frame.x(value);
    svg.append(draw('text', { x: at, y: height - 7, 'text-anchor': 'middle' }, compact(value)));
  }
  svg.append(draw('line', { class: 'axis', x1: frame.left, x2: frame.right, y1: frame.bottom, y2: frame.bottom }));
  return { ...frame, svg };
}

// As many panels in a row as fit, each with a minimum width.
function panelGrid(body, panels, narrowest, make) {
  const columns = Math.max(1, Math.min(panels.length, Math.floor(body.clientWidth / narrowest)));
  const width = Math.floor((body.clientWidth - (columns - 1) * 26) / columns);
  const grid = el('div', { class: 'panels', style: `grid-template-columns: repeat(${columns}, minmax(0, 1fr))` });
  grid.append(...panels.map((panel) => make(panel, width)));
  body.replaceChildren(grid);
}

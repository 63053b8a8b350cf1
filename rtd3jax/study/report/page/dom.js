// Elements, text and numbers. All text becomes text nodes, so names in a run are never markup.
const DATA = JSON.parse(document.getElementById('data').textContent);
const SVG = 'http://www.w3.org/2000/svg';

function fill(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes || {})) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith('on')) element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value === true ? '' : value);
  }
  for (const child of (children || []).flat()) {
    if (child !== null && child !== undefined) element.append(child);
  }
  return element;
}
const el = (tag, attributes, ...children) => fill(document.createElement(tag), attributes, children);
const draw = (tag, attributes, ...children) =>
  fill(document.createElementNS(SVG, tag), attributes, children);
const byId = (id) => document.getElementById(id);

const finite = (value) => typeof value === 'number' && Number.isFinite(value);
const MINUS = '\u2212';
const DASH = '\u2013';

function fixed(value, decimals) {
  if (!finite(value)) return DASH;
  const text = Math.abs(value).toLocaleString('en', {
    minimumFractionDigits: decimals, maximumFractionDigits: decimals,
  });
  const zero = !/[1-9]/.test(text);
  return (value < 0 && !zero ? MINUS : '') + text;
}

// Math.min(...values) fails for more than about a hundred thousand values.
const lowest = (values) => values.reduce((a, b) => Math.min(a, b), Infinity);
const highest = (values) => values.reduce((a, b) => Math.max(a, b), -Infinity);

// The decimals with which the largest value has four significant digits.
function decimalsFor(values) {
  const largest = Math.max(0, ...values.filter(finite).map(Math.abs));
  if (largest === 0) return 2;
  return Math.max(0, Math.min(12, 3 - Math.floor(Math.log10(largest))));
}

function compact(value) {
  for (const [size, unit] of [[1e9, 'G'], [1e6, 'M'], [1e3, 'k']]) {
    if (Math.abs(value) >= size) return `${+(value / size).toPrecision(4)}${unit}`;
  }
  return String(+value.toPrecision(6)).replace('-', MINUS);
}

const plural = (count, one, many) => `${count.toLocaleString('en')} ${count === 1 ? one : many || one + 's'}`;

function duration(seconds) {
  if (seconds >= 5400) return `${(seconds / 3600).toFixed(1)} h`;
  return seconds >= 90 ? `${(seconds / 60).toFixed(1)} min` : `${seconds.toFixed(0)} s`;
}

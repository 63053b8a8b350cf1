// The filter: sets of environments, agents and history lengths, for curves, returns and table.

const state = { environments: new Set(), agents: new Set(), lengths: new Set(), measure: 'return' };

const oneEnv = new Set(DATA.environments.map((environment) => environment.env)).size === 1;
function environmentName(environment) {
  const name = environment.disturbance === 'none' ? 'no disturbance' : environment.disturbance;
  return oneEnv ? name : `${environment.env}: ${name}`;
}
const lengthName = (length) => `history ${length}`;
const cellName = (cell) =>
  DATA.agents[cell.agent].name + (cell.length ? `, ${lengthName(cell.length)}` : '');
const lengthsOf = (cells) => [...new Set(cells.map((cell) => cell.length))].filter(Boolean).sort((a, b) => a - b);
const allLengths = lengthsOf(DATA.cells);

// An agent without a window is shown for every length.
const isShown = (cell) =>
  state.environments.has(cell.environment) && state.agents.has(cell.agent) &&
  (cell.length === 0 || state.lengths.has(cell.length));
const shownCells = () => DATA.cells.filter(isShown);

function chips(legend, set, items, update) {
  const boxes = items.map(({ value, label, agent }) => {
    const input = el('input', { type: 'checkbox', name: legend, value: String(value) });
    input.checked = set.has(value);
    input.addEventListener('change', () => {
      if (input.checked) set.add(value); else set.delete(value);
      update();
    });
    const mark = agent === undefined ? null : swatch(agent);
    return { input, value, node: el('label', { class: 'chip' }, input, mark, label) };
  });
  const all = el('button', { type: 'button', class: 'plain', 'aria-label': `all: ${legend}` }, 'all');
  all.addEventListener('click', () => {
    const fill = boxes.some((box) => !box.input.checked);
    for (const box of boxes) {
      box.input.checked = fill;
      if (fill) set.add(box.value); else set.delete(box.value);
    }
    update();
  });
  return el('fieldset', {}, el('legend', {}, legend), boxes.map((box) => box.node), items.length > 2 ? all : null);
}

function measureChoice(update) {
  const inputs = DATA.measures.map(([name, words]) => {
    const input = el('input', { type: 'radio', name: 'measure', value: name });
    input.checked = name === state.measure;
    input.addEventListener('change', () => { state.measure = name; update(); });
    return el('label', { class: 'chip' }, input, words);
  });
  return el('fieldset', {}, el('legend', {}, 'return'), inputs);
}

// A large study first shows its first environments: at most this number of panels of learning curves.
const MOST_PANELS = 12;

function firstEnvironments() {
  let panels = 0;
  return DATA.environments.map((_, index) => index).filter((index) => {
    panels += Math.max(1, lengthsOf(DATA.cells.filter((cell) => cell.environment === index)).length);
    return index === 0 || panels <= MOST_PANELS;
  });
}

function startFilters(update) {
  DATA.agents.forEach((_, index) => state.agents.add(index));
  allLengths.forEach((length) => state.lengths.add(length));
  firstEnvironments().forEach((index) => state.environments.add(index));
  const [first, all] = [state.environments.size, DATA.environments.length];
  const form = byId('filters').querySelector('form');
  form.addEventListener('submit', (event) => event.preventDefault());
  form.append(chips('disturbance', state.environments, DATA.environments.map((environment, value) => ({ value, label: environmentName(environment) })), update));
  form.append(chips('agent', state.agents, DATA.agents.map((agent, value) => ({ value, label: agent.name, agent: value })), update));
  if (allLengths.length) {
    form.append(chips('history length', state.lengths, allLengths.map((value) => ({ value, label: String(value) })), update));
  }
  if (DATA.measures.length > 1) form.append(measureChoice(update));
  if (first < all) form.append(el('p', { class: 'missing' }, `${first} of ${all} disturbances ${first === 1 ? 'is' : 'are'} selected at first; the charts and the table show the selected ones.`));
}

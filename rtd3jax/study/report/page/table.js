// The final returns as a table that can be sorted.

const sorting = { column: null, descending: false };

// A return on a scale from the uniform random policy (0) to the ceiling (1).
function normalised(value, environment) {
  const references = referencesOf(environment, state.measure);
  const random = references.find((r) => r.name === 'random');
  const best = references.find((r) => r.ceiling);
  return random && best && finite(value) ? (value - random.value) / (best.value - random.value) : null;
}

// Each row has the decimals of its own return: with those of -1000, a return of -1.3 would lose its digits.
function decimalsOfRow(row) {
  const final = row.final || {};
  return decimalsFor([final.iqm ?? final.mean]);
}

function tableColumns() {
  const final = (row) => row.final || {};
  const numeric = (name, value, places) => ({ name, number: true, value, text: (row) => fixed(value(row), places ?? decimalsOfRow(row)) });
  return [
    { name: 'disturbance', value: (row) => environmentName(row.environment), text: (row) => environmentName(row.environment) },
    { name: 'policy', value: (row) => row.name, text: (row) => (row.cell ? el('span', { class: 'agent' }, swatch(row.cell.agent), row.name) : row.name) },
    { name: 'history', number: true, value: (row) => (row.cell ? row.cell.length : null), text: (row) => (row.cell ? (row.cell.length || DASH) : DASH) },
    { name: 'seeds', number: true, value: (row) => final(row).n, text: (row) => (row.cell ? `${final(row).n || 0} of ${row.cell.seeds}` : DASH) },
    numeric('IQM', (row) => final(row).iqm),
    { name: '95 % interval', value: (row) => final(row).low, number: true,
      text: (row) => (finite(final(row).low) ? `${fixed(final(row).low, decimalsOfRow(row))} to ${fixed(final(row).high, decimalsOfRow(row))}` : DASH) },
    numeric('mean', (row) => final(row).mean),
    numeric('std', (row) => final(row).std),
    numeric('normalised', (row) => normalised(final(row).mean, row.environment), 3),
    { name: 'state', value: (row) => (row.cell ? stateOf(row.cell) : ''), text: (row) => (row.cell ? stateOf(row.cell) : '') },
  ];
}

function stateOf(cell) {
  const final = cell.final[state.measure];
  const lost = final && final.lost ? `, ${final.lost} lost` : '';
  const ended = final ? final.n + final.lost : 0;
  if (ended === cell.seeds) return `done${lost}`;
  // The words of --status, but for lanes that a sweep has begun and not ended.
  const { done = 0, failed = 0, running = 0, interrupted = 0 } = cell.statuses;
  const parts = [done && `${done} of ${cell.seeds} done`, failed && `${failed} failed`, (running || interrupted) && 'under way'];
  return `${parts.filter(Boolean).join(', ') || 'planned'}${lost}`;
}

function tableRows() {
  const rows = shownCells().map((cell) => ({ cell, environment: DATA.environments[cell.environment], name: DATA.agents[cell.agent].name, final: cell.final[state.measure] }));
  DATA.environments.forEach((environment, index) => {
    if (!state.environments.has(index)) return;
    for (const reference of referencesOf(environment, state.measure)) {
      rows.push({ cell: null, environment, name: reference.name, final: { mean: reference.value, iqm: null } });
    }
  });
  return rows;
}

function drawTable() {
  const section = byId('table');
  section.querySelector('.about').textContent =
    'Final returns; click a heading to sort. Normalised: 0 is the uniform random policy, 1 is the ceiling: the best possible return, or an upper bound of it.';
  const rows = tableRows();
  const columns = tableColumns();
  if (sorting.column !== null) {
    const { value } = columns[sorting.column];
    const sign = sorting.descending ? -1 : 1;
    const missing = (v) => v === null || v === undefined || v === '';
    rows.sort((a, b) => {
      const [one, other] = [value(a), value(b)];
      if (missing(one) || missing(other)) return missing(one) - missing(other);
      return sign * (typeof one === 'number' ? one - other : String(one).localeCompare(String(other)));
    });
  }
  const heads = columns.map((column, index) => {
    const chosen = sorting.column === index;
    const sort = chosen ? (sorting.descending ? 'descending' : 'ascending') : 'none';
    const press = () => {
      sorting.descending = chosen ? !sorting.descending : Boolean(column.number);
      sorting.column = index;
      drawTable();
      section.querySelectorAll('th button')[index].focus();
    };
    return el('th', { scope: 'col', class: column.number ? 'number' : null, 'aria-sort': sort }, el('button', { type: 'button', onclick: press }, column.name));
  });
  const lines = rows.map((row) => el('tr', { class: row.cell ? null : 'reference' },
    columns.map((column) => el('td', { class: column.number ? 'number' : null }, column.text(row)))));
  const table = el('table', { class: 'data' }, el('thead', {}, el('tr', {}, heads)), el('tbody', {}, lines));
  section.querySelector('.body').replaceChildren(el('div', { class: 'scroll', tabindex: 0, role: 'region', 'aria-label': 'Final returns' }, table));
}

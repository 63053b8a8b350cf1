// The transfer matrix: agents and their training disturbances in rows, test disturbances in columns.

function drawTransfer() {
  const section = byId('transfer');
  const about = section.querySelector('.about');
  const body = section.querySelector('.body');
  if (!DATA.transfer || !DATA.transfer.length) {
    about.textContent = 'The agents of this run have not been tested under other disturbances yet.';
    body.replaceChildren(el('p', { class: 'missing' }, 'python -m rtd3jax.transfer RUN --on ID ... tests them under the disturbances ID and draws this matrix; without --on, under the disturbances of the run.'));
    return;
  }
  about.textContent = 'Mean return as rewarded, over seeds (± their standard deviation), of agents trained under one disturbance and tested under another. Within a column, a stronger colour is better. ' +
    'A seed is lost if one of its returns is not a finite number: the mean leaves it out, and the cell has no colour.';
  const chosen = new Set([...state.agents].map((index) => DATA.agents[index].name));
  const blocks = [];
  for (const env of [...new Set(DATA.transfer.map((entry) => entry.env))]) {
    const entries = DATA.transfer.filter((entry) => entry.env === env);
    blocks.push(matrix(env, entries, chosen));
  }
  body.replaceChildren(...blocks);
}

// Whether the mean of a cell is that of all its seeds, so that it can be compared.
const isWhole = (entry) => finite(entry.mean) && !entry.lost;

// The mean and the small text below it. A policy that diverges must not take the decimals of the others.
function transferWords(entry) {
  const decimals = decimalsFor([entry.mean]);
  const spread = finite(entry.std) ? `± ${fixed(entry.std, decimals)}` : '';
  const lost = entry.lost ? `${entry.lost} of ${entry.n + entry.lost} lost` : '';
  return [fixed(entry.mean, decimals), [spread, lost].filter(Boolean).join(', ')];
}

function transferCell(entry, [low, high]) {
  if (!entry) return el('td', { class: 'value' }, DASH);
  const strength = high > low ? (entry.mean - low) / (high - low) : 1;
  const style = isWhole(entry) ? `background: rgba(var(--heat), ${(0.04 + 0.4 * strength).toFixed(3)})` : null;
  const [mean, below] = transferWords(entry);
  return el('td', { class: 'value', style }, mean, el('small', {}, below));
}

function matrix(env, entries, chosen) {
  const tested = [...new Set(entries.map((entry) => entry.tested_on))];
  const shown = entries.filter((entry) => chosen.has(entry.algorithm) && (!entry.history_length || state.lengths.has(entry.history_length)));
  const keyOf = (entry) => [entry.trained_on, entry.algorithm, entry.history_length].join('\n');
  const rows = [...new Map(shown.map((entry) => [keyOf(entry), entry])).values()];
  if (!rows.length) return el('p', { class: 'missing' }, `${env}: nothing is selected in the filter above.`);
  const ranges = new Map(tested.map((name) => {
    const values = shown.filter((entry) => entry.tested_on === name && isWhole(entry)).map((entry) => entry.mean);
    return [name, [Math.min(...values), Math.max(...values)]];
  }));
  const head = el('tr', {}, ['trained on', 'agent', 'history'].map((name) => el('th', { scope: 'col' }, name)),
    tested.map((name) => el('th', { scope: 'col' }, name)));
  const lines = rows.map((row) => el('tr', {}, el('td', {}, row.trained_on), el('td', {}, row.algorithm),
    el('td', { class: 'number' }, String(row.history_length || DASH)),
    tested.map((name) => transferCell(shown.find((entry) => keyOf(entry) === keyOf(row) && entry.tested_on === name), ranges.get(name)))));
  const table = el('table', { class: 'data matrix' }, el('thead', {}, head), el('tbody', {}, lines));
  return el('div', {}, el('h3', {}, env), el('div', { class: 'scroll', tabindex: 0, role: 'region', 'aria-label': `Transfer, ${env}` }, table));
}

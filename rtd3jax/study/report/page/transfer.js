// The transfer matrix: agents and their training disturbances in rows, test disturbances in columns.

function drawTransfer() {
  const section = byId('transfer');
  const about = section.querySelector('.about');
  const body = section.querySelector('.body');
  if (!DATA.transfer || !DATA.transfer.length) {
    about.textContent = 'The agents of this run have not been tested under other disturbances yet.';
    body.replaceChildren(el('p', { class: 'missing' }, 'python -m rtd3jax.transfer RUN tests them and draws this matrix.'));
    return;
  }
  about.textContent = 'Mean return as rewarded, over seeds (± their standard deviation), of agents trained under one disturbance and tested under another. Within a column, a stronger colour is better.';
  const chosen = new Set([...state.agents].map((index) => DATA.agents[index].name));
  const blocks = [];
  for (const env of [...new Set(DATA.transfer.map((entry) => entry.env))]) {
    const entries = DATA.transfer.filter((entry) => entry.env === env);
    blocks.push(matrix(env, entries, chosen));
  }
  body.replaceChildren(...blocks);
}

function matrix(env, entries, chosen) {
  const tested = [...new Set(entries.map((entry) => entry.tested_on))];
  const shown = entries.filter((entry) => chosen.has(entry.algorithm) && (!entry.history_length || state.lengths.has(entry.history_length)));
  const keyOf = (entry) => [entry.trained_on, entry.algorithm, entry.history_length].join('\n');
  const rows = [...new Map(shown.map((entry) => [keyOf(entry), entry])).values()];
  if (!rows.length) return el('p', { class: 'missing' }, `${env}: nothing is selected in the filter above.`);
  const decimals = decimalsFor(shown.map((entry) => entry.mean));
  const ranges = new Map(tested.map((name) => {
    const values = shown.filter((entry) => entry.tested_on === name).map((entry) => entry.mean).filter(finite);
    return [name, [Math.min(...values), Math.max(...values)]];
  }));
  const head = el('tr', {}, ['trained on', 'agent', 'history'].map((name) => el('th', { scope: 'col' }, name)),
    tested.map((name) => el('th', { scope: 'col' }, name)));
  const lines = rows.map((row) => el('tr', {}, el('td', {}, row.trained_on), el('td', {}, row.algorithm),
    el('td', { class: 'number' }, String(row.history_length || DASH)),
    tested.map((name) => {
      const entry = shown.find((other) => keyOf(other) === keyOf(row) && other.tested_on === name);
      if (!entry || !finite(entry.mean)) return el('td', { class: 'value' }, DASH);
      const [low, high] = ranges.get(name);
      const strength = high > low ? (entry.mean - low) / (high - low) : 1;
      return el('td', { class: 'value', style: `background: rgba(var(--heat), ${(0.04 + 0.4 * strength).toFixed(3)})` },
        fixed(entry.mean, decimals), el('small', {}, finite(entry.std) ? `± ${fixed(entry.std, decimals)}` : ''));
    })));
  const table = el('table', { class: 'data matrix' }, el('thead', {}, head), el('tbody', {}, lines));
  return el('div', {}, el('h3', {}, env), el('div', { class: 'scroll', tabindex: 0, role: 'region', 'aria-label': `Transfer, ${env}` }, table));
}

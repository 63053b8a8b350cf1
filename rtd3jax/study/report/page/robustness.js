// The test of robustness: a panel for each stress, with a line and a band per agent.

function robustnessPanels() {
  const panels = [];
  DATA.environments.forEach((environment, index) => {
    const here = DATA.robustness
      .map((entry) => ({ entry, cell: DATA.cells[entry.cell] }))
      .filter(({ entry, cell }) => cell.environment === index && isShown(cell) && entry.curves[state.measure]);
    const lengths = lengthsOf(here.map(({ cell }) => cell));
    for (const stress of [...new Set(here.map(({ entry }) => entry.stress))]) {
      const entries = here.filter(({ entry }) => entry.stress === stress);
      const { quantity } = entries[0].entry;
      // The same range for all lengths, so that the panels of a stress can be compared.
      const curves = entries.map(({ entry }) => entry.curves[state.measure]);
      const range = limits(curves.flatMap((curve) => [...curve.low, ...curve.high, ...curve.iqm]), []);
      for (const length of lengths.length ? lengths : [0]) {
        const cells = entries.filter(({ cell }) => cell.length === 0 || cell.length === length)
          .map(({ entry, cell }) => ({ ...cell, curves: entry.curves }));
        if (!cells.length) continue;
        const several = DATA.environments.length > 1;
        const title = [stress, several ? environmentName(environment) : null, lengths.length > 1 ? lengthName(length) : null].filter(Boolean).join(', ');
        panels.push({ environment, length, cells, range, title, under: quantity, at: (value) => `${quantity} ${compact(value)}` });
      }
    }
  });
  return panels;
}

function drawRobustness() {
  const section = byId('robustness');
  const about = section.querySelector('.about');
  const body = section.querySelector('.body');
  const legend = section.querySelector('.legend');
  if (!DATA.robustness || !DATA.robustness.length) {
    about.textContent = 'The robustness of the agents of this run has not been tested yet.';
    legend.replaceChildren();
    body.replaceChildren(el('p', { class: 'missing' }, 'python -m rtd3jax.stress RUN tests it and draws these charts.'));
    return;
  }
  about.textContent = 'Mean returns of the trained policies against the strength of a disturbance or a change of the plant: ' +
    'the interquartile mean over the seeds, with its 95 % bootstrap interval as a band. All agents meet the same episodes.';
  const panels = robustnessPanels();
  legend.replaceChildren(...(panels.length ? legendItems(panels) : []));
  if (panels.length) panelGrid(body, panels, 250, curvePanel);
  else body.replaceChildren(el('p', { class: 'missing' }, 'The filter above selects nothing.'));
}

// Metrics of learning, in a folded section: a row of panels for each metric.

function learningPanels() {
  const panels = [];
  for (const metric of DATA.metrics) {
    DATA.environments.forEach((environment, index) => {
      const cells = shownCells().filter((cell) => cell.environment === index && cell.learning[metric]);
      const lengths = lengthsOf(cells);
      for (const length of lengths.length ? lengths : [0]) {
        const here = cells.filter((cell) => cell.length === 0 || cell.length === length)
          .map((cell) => ({ ...cell, curves: { [state.measure]: cell.learning[metric] } }));
        if (!here.length) continue;
        const values = here.flatMap((cell) => cell.curves[state.measure].iqm);
        const title = [metric.replaceAll('_', ' '), environmentName(environment), length ? lengthName(length) : null].filter(Boolean).join(', ');
        panels.push({ environment, length, cells: here, range: limits(values, []), title });
      }
    });
  }
  return panels;
}

function drawLearning() {
  const section = byId('learning');
  section.hidden = !DATA.metrics.length;
  const fold = section.querySelector('details');
  if (section.hidden || !fold.open) return;
  const panels = learningPanels();
  section.querySelector('.about').textContent =
    'Metrics of learning, averaged between evaluations: the mean over the seeds. ' +
    'An action beyond 0.99 of its half range counts as saturated; the exploration return is the return of training episodes.';
  const body = section.querySelector('.body');
  if (panels.length) panelGrid(body, panels, 330, curvePanel);
  else body.replaceChildren(el('p', { class: 'missing' }, 'The filter above selects nothing.'));
}

function startLearning() {
  byId('learning').querySelector('details').addEventListener('toggle', drawLearning);
}

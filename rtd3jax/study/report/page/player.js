// Playback of episodes: an animated plant, and its signals with a cursor at the current frame.

const player = { environment: 0, cells: [], run: 0, frame: 0, playing: false, speed: 1, stages: [], last: 0 };
const FRAMES_PER_SECOND = 20;

function unpack({ scale: scales, data }) {
  const bytes = Uint8Array.from(atob(data), (character) => character.charCodeAt(0));
  const view = new DataView(bytes.buffer);
  const width = scales.length;
  return Array.from({ length: bytes.length / 2 / width }, (_, t) =>
    scales.map((size, k) => view.getInt16(2 * (t * width + k), true) * size));
}

function unpackRun(run) {
  const found = { steps: run.steps, true: unpack(run.true), action: unpack(run.action), reward: unpack(run.reward) };
  found.seen = run.seen ? unpack(run.seen) : found.true;
  if (run.hidden) found.hidden = unpack(run.hidden);
  return found;
}

function startPlayback() {
  const section = byId('playback');
  const about = section.querySelector('.about');
  const body = section.querySelector('.body');
  if (!DATA.playback.length) {
    about.textContent = !DATA.with_playback ? 'Episodes were left out (--no-playback).'
      : DATA.status.done && DATA.complete ? 'No episode could be recorded, or no agent has a finite return; see the notes above.'
      : DATA.complete ? 'No policy has been trained yet.'
      : 'Episodes are recorded when the sweep has ended; python -m rtd3jax.report RUN records episodes of the agents that are trained.';
    body.replaceChildren();
    return;
  }
  about.textContent = 'Two trained policies, each of the seed with the median return. All agents of an ' +
    'environment meet the same episodes. While the player has the focus, Space starts and stops the playback, and the arrow keys go to the next or previous frame.';
  const environments = [...new Set(DATA.playback.map((entry) => DATA.cells[entry.cell].environment))];
  player.environment = environments[0];
  const environmentSelect = selectOf('disturbance', environments.map((environment) => [environment, environmentName(DATA.environments[environment])]), (value) => {
    player.environment = Number(value);
    chooseDefault();
    rebuild();
  });
  const cellSelects = [0, 1].map((side) => selectOf(side ? 'second agent' : 'agent', [], (value) => {
    player.cells[side] = value === '' ? null : Number(value);
    rebuild();
  }));
  const runSelect = selectOf('episode', [], (value) => { player.run = Number(value); player.frame = 0; rebuild(); });
  const speedSelect = selectOf('speed', [[0.5, '½×'], [1, '1×'], [2, '2×'], [4, '4×']], (value) => { player.speed = Number(value); });
  speedSelect.select.value = '1';
  const play = el('button', { type: 'button', id: 'play' }, 'Play');
  play.addEventListener('click', toggle);
  const scrub = el('input', { type: 'range', id: 'scrub', min: 0, value: 0, 'aria-label': 'frame' });
  scrub.addEventListener('input', () => { player.playing = false; goTo(Number(scrub.value)); });
  const clock = el('span', { class: 'clock', id: 'clock' });
  const stages = el('div', { class: 'stages', tabindex: 0, role: 'group', 'aria-label': 'Episodes' });
  body.replaceChildren(
    el('div', { class: 'controls' }, environmentSelect.node, cellSelects.map((s) => s.node), runSelect.node),
    el('div', { class: 'controls' }, play, el('label', { class: 'scrub' }, scrub), clock, speedSelect.node),
    stages);
  section.addEventListener('keydown', (event) => {
    // A key keeps what it does in a control, and with a modifier: Alt and an arrow leave the page.
    const isOn = (...tags) => tags.includes(event.target.tagName);
    if (event.altKey || event.ctrlKey || event.metaKey) return;
    if (event.key === ' ' && !isOn('BUTTON', 'SELECT')) { event.preventDefault(); toggle(); }
    const move = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (move && !isOn('INPUT', 'SELECT')) { event.preventDefault(); player.playing = false; goTo(player.frame + move); }
  });

  const here = () => DATA.playback.filter((entry) => DATA.cells[entry.cell].environment === player.environment);
  function chooseDefault() {
    const entries = here();
    const value = (entry) => (DATA.cells[entry.cell].final.return || {}).mean ?? -Infinity;
    const best = [...entries].sort((a, b) => value(b) - value(a))[0];
    const other = entries.find((entry) => !DATA.cells[entry.cell].length && entry !== best) || entries.find((entry) => entry !== best);
    player.cells = [best.cell, other ? other.cell : null];
    player.run = 0;
    player.frame = 0;
  }
  function rebuild() {
    const options = here().map((entry) => [entry.cell, cellName(DATA.cells[entry.cell])]);
    cellSelects[0].options(options, player.cells[0]);
    cellSelects[1].options([['', 'nothing'], ...options], player.cells[1] ?? '');
    const entries = player.cells.map((cell) => here().find((entry) => entry.cell === cell)).filter(Boolean);
    runSelect.options(entries[0].runs.map((_, k) => [k, String(k + 1)]), player.run);
    player.stages = entries.map((entry) => makeStage(entry, Math.min(player.run, entry.runs.length - 1)));
    stages.replaceChildren(...player.stages.map((stage) => stage.node));
    player.stages.forEach((stage) => stage.build());
    scrub.max = Math.max(...player.stages.map((stage) => stage.run.steps)) - 1;
    goTo(Math.min(player.frame, Number(scrub.max)));
  }
  function goTo(frame) {
    player.frame = Math.max(0, Math.min(Number(scrub.max), frame));
    scrub.value = player.frame;
    const shown = `step ${player.frame + 1} of ${Number(scrub.max) + 1}`;
    clock.textContent = shown;
    scrub.setAttribute('aria-valuetext', shown);
    play.textContent = player.playing ? 'Pause' : 'Play';
    for (const stage of player.stages) stage.show(Math.min(player.frame, stage.run.steps - 1));
  }
  function toggle() {
    player.playing = !player.playing;
    if (player.playing && player.frame >= Number(scrub.max)) player.frame = 0;
    player.last = performance.now();
    goTo(player.frame);
    if (player.playing) requestAnimationFrame(tick);
  }
  function tick(now) {
    if (!player.playing) return;
    const due = Math.floor(((now - player.last) / 1000) * FRAMES_PER_SECOND * player.speed);
    if (due > 0) {
      player.last = now;
      if (player.frame + due >= Number(scrub.max)) player.playing = false;
      goTo(player.frame + due);
    }
    if (player.playing) requestAnimationFrame(tick);
  }
  player.rebuild = rebuild;
  chooseDefault();
  rebuild();
}

function selectOf(label, items, change) {
  const select = el('select', { name: label });
  select.addEventListener('change', () => change(select.value));
  const options = (list, value) => {
    select.replaceChildren(...list.map(([key, text]) => el('option', { value: String(key) }, text)));
    select.value = String(value);
  };
  options(items, items.length ? items[0][0] : '');
  return { select, options, node: el('label', {}, label, select) };
}

function makeStage(entry, index) {
  const run = unpackRun(entry.runs[index]);
  const scene = el('div', {});
  const readings = el('dl', {});
  const traces = el('div', {});
  const total = run.reward.reduce((sum, [reward]) => sum + reward, 0);
  const title = `${cellName(DATA.cells[entry.cell])}, seed ${entry.seed}: return ${fixed(total, decimalsFor([total]))}` +
    (entry.cut && run.steps >= entry.cut ? ` over its first ${entry.cut} steps` : '');
  const node = el('div', { class: 'stage' }, el('h3', {}, swatch(DATA.cells[entry.cell].agent), ' ', title), scene, readings, traces);
  const stage = { node, run };
  stage.build = () => {
    const width = node.clientWidth;
    const picture = (SCENES[entry.kind] || noScene)(entry, run, width);
    scene.replaceChildren(...(picture.svg ? [picture.svg] : []));
    const signals = tracesOf(entry, run).map((trace) => ({ ...trace, axis: traceAxis(trace) }));
    // The same margin for all signals, so that their cursors are in one line.
    const left = marginFor(signals.flatMap(({ axis }) => axis.texts));
    const rows = signals.map((signal) => makeTrace(signal, run, left, width));
    traces.replaceChildren(...rows.map((row) => row.node));
    stage.show = (t) => {
      picture.show(t);
      rows.forEach((row) => row.show(t));
      readings.replaceChildren(...picture.readings(t).map(([name, text]) => el('div', {}, el('dt', {}, name), el('dd', {}, text))));
    };
  };
  return stage;
}

const noScene = (entry, run) => ({ svg: null, show() {}, readings: (t) => [['reward', fixed(run.reward[t][0], 3)]] });

const SCENES = {
  // The upright position is up. The rod shows the true state; the dot shows the observed end of the rod.
  pendulum(entry, run, width) {
    const height = 210;
    const size = 78;
    const [cx, cy] = [width / 2, height / 2];
    const rod = draw('line', { x1: cx, y1: cy, 'stroke-width': 9, 'stroke-linecap': 'round', stroke: 'currentColor', class: 'truth' });
    const seen = draw('circle', { r: 6, fill: 'none', stroke: 'currentColor', 'stroke-width': 2.5, class: 'seen' });
    const ghost = draw('line', { x1: cx, y1: cy, stroke: 'currentColor', 'stroke-width': 1.5, 'stroke-dasharray': '4 3', class: 'seen' });
    const torque = draw('path', { fill: 'none', stroke: 'currentColor', 'stroke-width': 3, class: 's0' });
    const svg = draw('svg', { class: 'scene', height, viewBox: `0 0 ${width} ${height}`, role: 'img', 'aria-label': 'pendulum' },
      draw('circle', { cx, cy, r: size, class: 'axis', fill: 'none' }), draw('line', { class: 'axis', x1: cx, x2: cx, y1: cy - size - 8, y2: cy - size }),
      torque, rod, draw('circle', { cx, cy, r: 5, class: 'truth', fill: 'currentColor' }), ghost, seen);
    const sees = (k) => (entry.elements ? entry.elements.indexOf(k) : -1);
    const [ix, iy] = [sees(0), sees(1)];
    const keep = (value, middle, most) => Math.max(8 - middle, Math.min(most - 8 - middle, value)) + middle;
    return {
      svg,
      show(t) {
        const [cosine, sine] = run.true[t];
        fill(rod, { x2: cx - size * sine, y2: cy - size * cosine });
        const known = ix >= 0 && iy >= 0;
        for (const part of [seen, ghost]) part.setAttribute('visibility', known ? 'visible' : 'hidden');
        if (known) {
          const x = keep(-size * run.seen[t][iy], cx, width);
          const y = keep(-size * run.seen[t][ix], cy, height);
          fill(seen, { cx: x, cy: y });
          fill(ghost, { x2: x, y2: y });
        }
        const angle = (2 * run.action[t][0]) / (entry.constants.max_torque || 1);
        const [r, end] = [26, -angle];
        const large = Math.abs(end) > Math.PI ? 1 : 0;
        torque.setAttribute('d', `M ${cx} ${cy - r} A ${r} ${r} 0 ${large} ${end > 0 ? 1 : 0} ${cx + r * Math.sin(end)} ${cy - r * Math.cos(end)}`);
      },
      readings: (t) => [
        ['angle from upright', `${fixed((Math.atan2(run.true[t][1], run.true[t][0]) * 180) / Math.PI, 0)}°`],
        ['torque', fixed(run.action[t][0], 2)], ['reward', fixed(run.reward[t][0], 2)],
      ],
    };
  },

  // View from above; the rover drives to the right. If the step has no length in seconds, 0.1 s is assumed.
  rover(entry, run, width) {
    const step = entry.seconds ?? 0.1;
    const { target_speed: speed, target_yaw_rate: turn, wheelbase } = entry.constants;
    const travel = (motion) => {
      const poses = [[0, 0, 0]];
      for (const [v, omega] of motion) {
        const [x, y, heading] = poses[poses.length - 1];
        const next = heading + omega * step;
        poses.push([x + v * step * Math.cos(next), y + v * step * Math.sin(next), next]);
      }
      return poses;
    };
    const poses = travel(run.true.map(([v, omega]) => [v + speed, omega + turn]));
    const wanted = travel(run.true.map(() => [speed, turn]));
    const height = 210;
    const zoom = 46;
    const line = (kind) => draw('polyline', { fill: 'none', stroke: 'currentColor', 'stroke-width': 2, class: kind, 'stroke-dasharray': kind === 'goal' ? '5 4' : null });
    const [goal, path] = [line('goal'), line('truth')];
    const wheel = (side) => draw('rect', { x: -11, y: side * ((wheelbase / 2) * zoom) - 4.5, width: 22, height: 9, rx: 2.5, class: side < 0 ? 's0' : 's1', fill: 'currentColor' });
    const wheels = [wheel(-1), wheel(1)];
    const body = draw('g', {}, draw('rect', { x: -17, y: -9, width: 34, height: 18, rx: 4, class: 'truth', fill: 'currentColor' }), wheels,
      draw('path', { d: 'M 20 0 l -5 -4 v 8 z', class: 'truth', fill: 'currentColor' }));
    const target = draw('circle', { r: 5, fill: 'none', stroke: 'currentColor', 'stroke-width': 2, class: 'goal' });
    const svg = draw('svg', { class: 'scene', height, viewBox: `0 0 ${width} ${height}`, role: 'img', 'aria-label': 'rover from above' }, goal, path, target, body);
    return {
      svg,
      show(t) {
        const [px, py, heading] = poses[t + 1];
        const place = ([x, y]) => [width * 0.55 + (x - px) * zoom, height / 2 - (y - py * 0.5) * zoom];
        const text = (list) => list.slice(Math.max(0, t - 90), t + 2).map((pose) => place(pose).map((v) => v.toFixed(1)).join(',')).join(' ');
        fill(path, { points: text(poses) });
        fill(goal, { points: text(wanted) });
        const [x, y] = place([px, py]);
        body.setAttribute('transform', `translate(${x.toFixed(1)} ${y.toFixed(1)}) rotate(${((-heading * 180) / Math.PI).toFixed(2)})`);
        const [gx, gy] = place(wanted[t + 1]);
        fill(target, { cx: gx, cy: gy });
        // The colour of a wheel becomes lighter with slip.
        wheels.forEach((node, side) => node.setAttribute('opacity', run.hidden ? Math.max(0.15, 1 - 2 * run.hidden[t][side]).toFixed(2) : 1));
      },
      readings: (t) => [
        ['speed', `${fixed(run.true[t][0] + speed, 2)} m/s`], ['yaw rate', `${fixed(run.true[t][1] + turn, 2)} rad/s`],
        ...(run.hidden ? [['slip left, right', `${fixed(run.hidden[t][0], 2)}, ${fixed(run.hidden[t][1], 2)}`]] : []),
        ['reward', fixed(run.reward[t][0], 4)],
      ],
    };
  },
};

// The signals below the scene: true and observed values, their difference, the hidden variable, the action.
function tracesOf(entry, run) {
  const column = (table, k) => table.map((row) => row[k]);
  const found = [];
  entry.names.forEach((name, k) => {
    const lines = [{ name: 'true', kind: 'truth', values: column(run.true, k) }];
    const seen = entry.elements ? entry.elements.indexOf(k) : -1;
    if (run.seen !== run.true && seen >= 0) lines.push({ name: 'observed', kind: 'seen', values: column(run.seen, seen) });
    found.push({ name: name + (entry.elements && seen < 0 ? ' (hidden from the agent)' : ''), lines });
  });
  if (run.seen !== run.true && entry.elements) {
    const lines = entry.elements.map((k, seen) => ({ name: entry.names[k], kind: `s${seen % 4}`, values: run.true.map((row, t) => run.seen[t][seen] - row[k]) }));
    found.push({ name: 'disturbance: observed minus true', lines });
  } else if (run.seen !== run.true) {
    const lines = run.seen[0].slice(0, 4).map((_, k) => ({ name: `observed ${k}`, kind: `s${k}`, values: column(run.seen, k) }));
    found.push({ name: 'observation', lines });
  }
  if (run.hidden) found.push({ name: `disturbance: ${entry.hidden.name}`, lines: entry.hidden.elements.slice(0, 4).map((name, k) => ({ name, kind: `s${k}`, values: column(run.hidden, k) })) });
  found.push({ name: 'action', lines: entry.actions.slice(0, 4).map((name, k) => ({ name, kind: `s${k}`, values: column(run.action, k) })) });
  return found;
}

// The limits and the numbers of a signal's axis.
function traceAxis({ lines }) {
  const values = lines.flatMap((line) => line.values);
  const [low, high] = [lowest(values), highest(values)];
  const margin = 0.08 * (high - low || 1);
  const marks = ticks(low - margin, high + margin, 2);
  return { low: low - margin, high: high + margin, values: marks.values, texts: marks.values.map((value) => fixed(value, marks.decimals)) };
}

function makeTrace({ name, lines, axis }, run, left, width) {
  const height = 62;
  const x = scale(0, Math.max(1, run.steps - 1), left, width - 6);
  const y = scale(axis.low, axis.high, height - 4, 4);
  const svg = draw('svg', { class: 'plot', width, height, viewBox: `0 0 ${width} ${height}`, 'aria-hidden': 'true' });
  axis.values.forEach((value, k) => {
    svg.append(draw('line', { class: 'grid', x1: left, x2: width - 6, y1: y(value), y2: y(value) }));
    svg.append(draw('text', { x: left - 5, y: y(value) + 4, 'text-anchor': 'end' }, axis.texts[k]));
  });
  for (const line of lines) {
    const points = line.values.map((value, t) => `${x(t).toFixed(1)},${y(value).toFixed(1)}`).join(' ');
    svg.append(draw('polyline', { class: `line ${line.kind}`, points, 'stroke-width': 1.4 }));
  }
  const cursor = draw('line', { class: 'cross', y1: 2, y2: height - 2 });
  svg.append(cursor);
  const key = el('div', { class: 'key' }, el('b', {}, name), lines.map((line) =>
    el('i', {}, el('span', { class: `swatch ${line.kind}` }), line.name)));
  return { node: el('div', { class: 'trace' }, key, svg), show: (t) => fill(cursor, { x1: x(t), x2: x(t) }) };
}

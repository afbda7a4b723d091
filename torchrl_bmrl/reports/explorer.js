// The embedding explorer: points of episodes; one episode is chosen and played. A point is a moment
// of its episode or, if data.still, the whole episode, which a click plays.
// All text from data is set as textContent, never as markup.
(() => {
  "use strict";

  const root = document.currentScript.closest(".explorer");
  const part = (name) => root.querySelector(`[data-part="${name}"]`);
  const data = JSON.parse(root.querySelector('script[type="application/json"]').textContent);
  const canvas = part("canvas");
  const context = canvas.getContext("2d");
  const slider = part("slider");
  // Only a family's members have parameters, which colour them, groups and facts.
  const { still = false, parameters = [], groups = [], facts = [] } = data;

  const REACH = 14; // a point answers to a pointer this near [px]

  // The selection. A point is an episode (its index in data.episodes) and one of its rows.
  const state = { task: -1, episode: 0, row: 0, hovered: null, playing: false };
  let view = null; // from embedding to pixels
  let background = null; // all points, redrawn only when they change

  // -- data -----------------------------------------------------------------------------------

  // A distance is null where unknown; a period is null if the duration of a step is unknown.
  const measured = data.episodes.some((e) => e.distance.some((d) => d !== null));
  const farthest = Math.max(...data.episodes.map((e) => Math.max(...e.distance)), 1e-9);
  const seconds = (episode, row) => episode.step[row] * (data.tasks[episode.task].period || 0.05);
  const meters = (distance) => (distance === null ? "–" : `${distance.toFixed(3)} m`);
  const timeOf = (episode, row) =>
    data.tasks[episode.task].period
      ? `${seconds(episode, row).toFixed(2)} s`
      : `step ${episode.step[row]}`;
  const shown = () => data.episodes.filter((e) => state.task < 0 || e.task === state.task);
  const hasFrames = (episode) => Object.keys(episode.frames).length > 0;

  function color(episode, row) {
    const coloring = part("coloring").value;
    const parameter = parameters[coloring];
    if (parameter) {
      const { scale, low, high, values } = parameter;
      return shade(scale, (values[episode.task] - low) / (high - low || 1));
    }
    if (coloring === "phase") return data.phases[episode.phase[row]].color;
    if (coloring === "distance") {
      const distance = episode.distance[row];
      return distance === null ? "#b0b4ba" : shade(VIRIDIS, distance / farthest);
    }
    return data.tasks[episode.task].color;
  }

  // The last picture taken at or before a row, as [step, base64].
  function frameAt(episode, row) {
    const steps = Object.keys(episode.frames).map(Number);
    const before = steps.filter((step) => step <= episode.step[row]);
    const step = before.length ? Math.max(...before) : steps[0];
    return step === undefined ? null : [step, episode.frames[step]];
  }

  // -- drawing --------------------------------------------------------------------------------

  function fit() {
    const box = canvas.getBoundingClientRect();
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(box.width * ratio);
    canvas.height = Math.round(box.height * ratio);
    const x = shown().flatMap((e) => e.x);
    const y = shown().flatMap((e) => e.y);
    const range = (values) => {
      const low = values.reduce((a, b) => Math.min(a, b));
      const high = values.reduce((a, b) => Math.max(a, b));
      return [(low + high) / 2, high - low];
    };
    const [middleX, spanX] = range(x);
    const [middleY, spanY] = range(y);
    const width = box.width - MARGIN.left - MARGIN.right;
    const height = box.height - MARGIN.top - MARGIN.bottom;
    // Distances are what one reads off: one unit is as long both ways.
    const scale = 0.94 * Math.min(width / (spanX || 1), height / (spanY || 1));
    view = {
      ratio, width, height, scale,
      x: (value) => MARGIN.left + width / 2 + (value - middleX) * scale,
      y: (value) => MARGIN.top + height / 2 - (value - middleY) * scale,
      low: [middleX - width / 2 / scale, middleY - height / 2 / scale],
      high: [middleX + width / 2 / scale, middleY + height / 2 / scale],
    };
  }

  function drawBackground() {
    background = document.createElement("canvas");
    [background.width, background.height] = [canvas.width, canvas.height];
    const pen = background.getContext("2d");
    pen.setTransform(view.ratio, 0, 0, view.ratio, 0, 0);
    const rowsOf = (e) => (still ? [0] : e.x.map((_, row) => row));
    const points = shown().flatMap((e) => rowsOf(e).map((row) => [e, row]));
    // In a mixed order, the same each time, no task hides the others where they overlap.
    const stride = [7919, 7907, 7901].find((prime) => points.length % prime) || 1;
    const radius = still ? 6 : points.length > 2000 ? 2.2 : 3;
    const edge = still && "#1d2129"; // light colours need it on white
    for (let i = 0; i < points.length; i += 1) {
      const [episode, row] = points[(i * stride) % points.length];
      dot(pen, episode, row, radius, color(episode, row), edge, 1);
    }
  }

  function dot(pen, episode, row, radius, fill, edge, width = 2) {
    const mark = groups.length ? groups[data.tasks[episode.task].group].mark : "circle";
    drawMark(pen, view.x(episode.x[row]), view.y(episode.y[row]), radius, mark, fill, edge, width);
  }

  function line(episode, first, last, stroke, width) {
    context.beginPath();
    for (let row = first; row <= last; row += 1) {
      context.lineTo(view.x(episode.x[row]), view.y(episode.y[row]));
    }
    context.strokeStyle = stroke;
    context.lineWidth = width;
    context.stroke();
  }

  function draw() {
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, canvas.width, canvas.height);
    context.setTransform(view.ratio, 0, 0, view.ratio, 0, 0);
    drawAxes(context, view, data.axes);
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.globalAlpha = still ? 1 : 0.5; // so that the chosen episode stands out
    context.drawImage(background, 0, 0);
    context.globalAlpha = 1;
    context.setTransform(view.ratio, 0, 0, view.ratio, 0, 0);
    const chosen = data.episodes[state.episode];
    if (!still) chosen.x.forEach((_, row) => dot(context, chosen, row, 3, color(chosen, row)));
    // The whole episode faintly, because it may be a tangle; its last ten steps clearly.
    line(chosen, 0, chosen.x.length - 1, "rgba(29, 33, 41, 0.3)", 0.8);
    line(chosen, Math.max(0, state.row - 10), state.row, "#1d2129", 2);
    dot(context, chosen, state.row, still ? 9 : 7, color(chosen, state.row), "#000");
    if (!state.hovered) return;
    const [index, row] = state.hovered;
    const hovered = data.episodes[index];
    dot(context, hovered, row, still ? 8 : 6, still ? color(hovered, row) : "#fff", "#000");
  }

  function drawLegend() {
    const legend = part("legend");
    legend.replaceChildren();
    const entry = (text, background, shape = "swatch") => {
      const [item, mark] = [document.createElement("li"), document.createElement("span")];
      mark.className = shape;
      mark.style.background = background;
      item.append(mark, text);
      legend.append(item);
    };
    const coloring = part("coloring").value;
    groups.forEach(({ name, mark }) => entry(name, "#1d2129", `swatch ${mark}`));
    const parameter = parameters[coloring];
    if (parameter) {
      entry(parameter.legend, `linear-gradient(90deg, ${parameter.scale.join(", ")})`, "ramp");
      return;
    }
    if (coloring === "distance") {
      const ramp = `linear-gradient(90deg, ${VIRIDIS.join(", ")})`;
      entry(`distance to goal: 0 to ${farthest.toFixed(2)} m`, ramp, "ramp");
      return;
    }
    const kinds = coloring === "phase" ? data.phases : data.tasks;
    const present = new Set(shown().flatMap((e) => (coloring === "phase" ? e.phase : e.task)));
    kinds.forEach((kind, i) => present.has(i) && entry(kind.name, kind.color));
  }

  // -- details --------------------------------------------------------------------------------

  function describe() {
    const [index, row] = state.hovered || [state.episode, state.row];
    const episode = data.episodes[index];
    const task = data.tasks[episode.task].name;
    const time = timeOf(episode, row);
    const say = (name, text) => { part(`show-${name}`).textContent = text; };
    say("task", task);
    facts.forEach((_, i) => say(`fact-${i}`, data.tasks[episode.task].facts[i]));
    const period = data.tasks[episode.task].period;
    say("time", period ? `${time} (step ${episode.step[row]})` : time);
    if (!still) {
      say("episode", `${episode.number} of ${episode.of}`);
      say("phase", data.phases[episode.phase[row]].name);
      say("distance", meters(episode.distance[row]));
      say("success", episode.success[row] === null ? "–" : episode.success[row] ? "yes" : "no");
    }
    const signed = (value) => value.toPrecision(3).replace("-", "−");
    say("point", `(${signed(episode.x[row])}, ${signed(episode.y[row])})`);
    part("which").textContent = state.hovered ? "Under the pointer" : "Chosen point";

    const frame = frameAt(episode, row);
    const picture = part("frame");
    picture.hidden = !frame;
    part("noframe").hidden = Boolean(frame);
    if (frame) {
      const source = `data:image/webp;base64,${frame[1]}`;
      if (picture.src !== source) picture.src = source;
      const at = timeOf({ task: episode.task, step: [frame[0]] }, 0);
      picture.alt = `${still ? task : `${task}, episode ${episode.number}`}, at ${at}`;
    } else {
      part("noframe").textContent = data.note || "No pictures were made of this episode.";
    }

    const chosen = data.episodes[state.episode];
    const clock = timeOf(chosen, state.row);
    const distance = chosen.distance[state.row];
    slider.value = state.row;
    slider.setAttribute("aria-valuetext", distance === null ? clock : `${clock}, ${meters(distance)}`);
    part("clock").textContent = clock;
    part("play").textContent = state.playing ? "Pause" : "Play";
  }

  function refresh() {
    draw();
    describe();
  }

  function redraw() {
    fit();
    drawBackground();
    drawLegend();
    refresh();
  }

  // -- choosing -------------------------------------------------------------------------------

  function option(text, value) {
    const element = document.createElement("option");
    element.textContent = text;
    element.value = value;
    return element;
  }

  function listEpisodes() {
    const options = data.episodes.flatMap((e, i) => {
      if (state.task >= 0 && e.task !== state.task) return [];
      const film = hasFrames(e) ? " (film)" : "";
      const number = still ? "" : ` ${e.number}`;
      return [option(`${data.tasks[e.task].name}${number}${film}`, i)];
    });
    part("episode").replaceChildren(...options);
  }

  function choose(episode, row) {
    state.episode = episode;
    state.row = row;
    slider.max = data.episodes[episode].x.length - 1;
    part("episode").value = episode;
    refresh();
  }

  function chooseTask(task) {
    stop();
    state.task = task;
    state.hovered = null;
    listEpisodes();
    const candidates = shown();
    const first = candidates.find(hasFrames) || candidates[0];
    fit();
    drawBackground();
    drawLegend();
    choose(data.episodes.indexOf(first), 0);
  }

  function nearest(event) {
    const box = canvas.getBoundingClientRect();
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    let found = null;
    let best = REACH ** 2;
    data.episodes.forEach((episode, index) => {
      if (state.task >= 0 && episode.task !== state.task) return;
      for (let row = 0; row < episode.x.length; row += 1) {
        const away = (view.x(episode.x[row]) - x) ** 2 + (view.y(episode.y[row]) - y) ** 2;
        if (away < best) [best, found] = [away, [index, row]];
      }
    });
    return found;
  }

  // -- playing --------------------------------------------------------------------------------

  function stop() {
    state.playing = false;
  }

  function play() {
    const episode = data.episodes[state.episode];
    const last = episode.x.length - 1;
    if (state.row === last) state.row = 0;
    state.playing = true;
    state.hovered = null;
    const begun = performance.now() / 1000 - seconds(episode, state.row);
    const advance = () => {
      if (!state.playing) return;
      const now = performance.now() / 1000 - begun; // as fast as the robot moved
      while (state.row < last && seconds(episode, state.row + 1) <= now) state.row += 1;
      if (state.row === last) stop();
      refresh();
      requestAnimationFrame(advance);
    };
    advance();
  }

  part("play").addEventListener("click", () => {
    if (state.playing) stop();
    else play();
    refresh();
  });
  slider.addEventListener("input", () => {
    stop();
    choose(state.episode, Number(slider.value));
  });
  part("task").addEventListener("change", (event) => chooseTask(Number(event.target.value)));
  part("episode").addEventListener("change", (event) => {
    stop();
    choose(Number(event.target.value), 0);
  });
  part("coloring").addEventListener("change", redraw);
  canvas.addEventListener("mousemove", (event) => {
    state.hovered = nearest(event);
    canvas.style.cursor = state.hovered ? "pointer" : "default";
    // The pointer stays on the point that it clicked, whose film plays.
    if (still && state.hovered && state.hovered[0] === state.episode) state.hovered = null;
    refresh();
  });
  canvas.addEventListener("mouseleave", () => {
    state.hovered = null;
    refresh();
  });
  canvas.addEventListener("click", (event) => {
    const found = nearest(event);
    if (!found) return;
    stop();
    choose(...found);
    if (still) play();
  });

  part("task").append(option("All tasks", -1));
  data.tasks.forEach((task, i) => {
    if (data.episodes.some((e) => e.task === i)) part("task").append(option(task.name, i));
  });
  if (still) {
    part("task").parentElement.hidden = true;
    part("episode").parentElement.firstChild.textContent = "Task ";
    part("coloring").replaceChildren(...parameters.map(({ name }, i) => option(name, i)));
    const filmed = data.episodes.some(hasFrames);
    part("play").parentElement.hidden = !filmed;
    for (const name of ["episode", "phase", "distance", "success", ...(filmed ? [] : ["time"])]) {
      const value = part(`show-${name}`);
      value.hidden = value.previousElementSibling.hidden = true;
    }
    facts.forEach((fact, i) => {
      const [name, value] = [document.createElement("dt"), document.createElement("dd")];
      name.textContent = fact;
      value.dataset.part = `show-fact-${i}`;
      part("show-time").previousElementSibling.before(name, value);
    });
  }
  if (!measured && !still) part("coloring").querySelector('[value="distance"]').remove();
  canvas.setAttribute("aria-label", data.description);
  chooseTask(-1);
  new ResizeObserver(redraw).observe(canvas);
})();

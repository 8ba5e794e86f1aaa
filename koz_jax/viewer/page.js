"use strict";
(() => {
  const content = JSON.parse(document.getElementById("content").textContent);
  const slider = document.getElementById("time");
  const play = document.getElementById("play");
  const speed = document.getElementById("speed");
  const clock = document.getElementById("clock");
  const last = content.frames - 1;
  const options = { responsive: true, displayModeBar: false };

  // ---- the page's elements
  function element(tag, className, text) {
    const made = document.createElement(tag);
    made.className = className;
    made.textContent = text;
    return made;
  }

  function addManeuver(maneuver) {
    const section = document.createElement("section");
    const verdicts = element("ul", "verdicts", "");
    for (const { text, good } of maneuver.verdicts) {
      verdicts.append(element("li", good === null ? "" : good ? "good" : "bad", text));
    }
    const view = {
      maneuver,
      scene: element("div", "scene", ""),
      timeline: element("div", "timeline", ""),
      readout: element("p", "readout", ""),
      busy: false,
      drawn: -1,
    };
    section.append(element("h2", "", maneuver.label), verdicts, view.scene, view.readout, view.timeline);
    document.getElementById("maneuvers").append(section);
    return view;
  }

  // ---- one instant of one maneuver
  // v + 2 q0 (q x v) + 2 q x (q x v), as from body components to inertial ones.
  function rotate([q0, q1, q2, q3], point) {
    if (point === null) return [null, null, null];
    const [x, y, z] = point;
    const [tx, ty, tz] = [2 * (q2 * z - q3 * y), 2 * (q3 * x - q1 * z), 2 * (q1 * y - q2 * x)];
    return [
      x + q0 * tx + (q2 * tz - q3 * ty),
      y + q0 * ty + (q3 * tx - q1 * tz),
      z + q0 * tz + (q1 * ty - q2 * tx),
    ];
  }

  // What Plotly.restyle takes: new values for some traces, by their numbers.
  function sceneAt({ data, turning }, frame) {
    const found = { x: [], y: [], z: [], "line.color": [] };
    const indices = [];
    function put(index, points, colors) {
      indices.push(index);
      ["x", "y", "z"].forEach((axis, i) => found[axis].push(points.map((point) => point[i])));
      found["line.color"].push(colors);
    }
    const pointsOf = ({ x, y, z }) => x.map((_, i) => (x[i] === null ? null : [x[i], y[i], z[i]]));

    for (const { traces, turns } of turning) {
      for (const index of traces) {
        const { line } = data[index];
        put(index, pointsOf(data[index]).map((point) => rotate(turns[frame], point)), line && line.color);
      }
    }
    const named = (name) => data.findIndex((trace) => trace.name === name);
    const trail = data[named("boresight trail")];
    const seen = pointsOf(trail).slice(0, frame + 1);
    put(named("boresight trail"), seen, trail.line.color.slice(0, frame + 1));
    put(named("now"), seen.slice(-1));
    return [found, indices];
  }

  function readoutAt(maneuver, frame) {
    const [margin, error, ...torque] = maneuver.timeline.data.map((curve) => curve.y[frame]);
    const norm = Math.hypot(...torque);
    const digits = norm < 999.5 ? norm.toPrecision(3) : norm.toFixed(0);
    return `margin ${margin.toFixed(1)}°, error ${error.toFixed(2)}°, torque ${digits} ${maneuver.torqueUnit}`;
  }

  async function draw(view) {
    if (view.busy) return; // drawn with the newest time once the present drawing is done
    view.busy = true;
    try {
      while (view.drawn !== frameNow()) {
        const frame = frameNow();
        const time = frame * content.frameSeconds;
        view.drawn = frame;
        view.readout.textContent = readoutAt(view.maneuver, frame);
        await Plotly.relayout(view.timeline, { "shapes[0].x0": time, "shapes[0].x1": time });
        await Plotly.restyle(view.scene, ...sceneAt(view.maneuver.scene, frame));
      }
    } finally {
      view.busy = false;
    }
  }

  // ---- time
  const frameNow = () => Number(slider.value);

  function show(frame) {
    slider.value = String(Math.max(0, Math.min(last, Math.round(frame))));
    const seconds = (at) => (at * content.frameSeconds).toFixed(1);
    clock.textContent = `${seconds(frameNow())} s of ${seconds(last)} s`;
    views.forEach(draw);
  }

  let playing = null; // number of the animation request, while it plays
  function pause() {
    cancelAnimationFrame(playing);
    playing = null;
    play.textContent = "Play";
  }

  function start() {
    if (frameNow() === last) show(0);
    let position = frameNow();
    let before = performance.now();
    const advance = (now) => {
      position += ((now - before) / 1000) * Number(speed.value) / content.frameSeconds;
      before = now;
      show(position);
      if (position >= last) pause();
      else playing = requestAnimationFrame(advance);
    };
    play.textContent = "Pause";
    playing = requestAnimationFrame(advance);
  }

  const toggle = () => (playing === null ? start() : pause());

  // ---- begin
  function turnTogether(view) {
    view.scene.on("plotly_relayout", (change) => {
      const camera = change["scene.camera"];
      if (!camera || view.following) return;
      for (const other of views.filter((candidate) => candidate !== view)) {
        other.following = true;
        Plotly.relayout(other.scene, { "scene.camera": camera }).then(() => { other.following = false; });
      }
    });
  }

  const views = content.maneuvers.map(addManeuver);
  slider.max = String(last);
  slider.addEventListener("input", () => { pause(); show(frameNow()); });
  play.addEventListener("click", toggle);
  document.addEventListener("keydown", (event) => {
    if (event.code !== "Space" || event.target === play || event.target === speed) return;
    event.preventDefault();
    toggle();
  });
  const drawn = views.map(async (view) => {
    const { scene, timeline } = view.maneuver;
    // Plotly keeps and changes what it is given; the page needs the whole trail later.
    await Plotly.newPlot(view.scene, structuredClone(scene.data), scene.layout, options);
    await Plotly.newPlot(view.timeline, timeline.data, timeline.layout, options);
    turnTogether(view);
    view.timeline.on("plotly_click", ({ points }) => {
      pause();
      show(points[0].x / content.frameSeconds);
    });
  });
  Promise.all(drawn).then(() => {
    show(0);
    document.body.dataset.ready = "true";
  });
})();

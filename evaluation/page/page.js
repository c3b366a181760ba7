// Shows the content of the page: `page` is one JSON object; each volume has its own element with its voxels, as 16-bit
// integers, gzip, base64. All text reaches the document as text, never as markup.
"use strict";
(async () => {
  const byId = (id) => document.getElementById(id);
  const page = JSON.parse(byId("page").textContent);
  const { volumes, runs, scans } = page;

  /** An element with attributes and children; strings become text nodes. */
  function element(name, attributes = {}, ...children) {
    const made = document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    made.append(...children.flat().filter((c) => c !== null && c !== undefined));
    return made;
  }
  const row = (name, cells) => element("tr", {}, cells.map((c) => (c instanceof Node ? c : element(name, {}, c))));
  const figure = (text) => element("td", { class: "number" }, text);
  const short = (x, digits = 5) => {
    if (x === null || x === undefined) return "-";
    if (!Number.isFinite(x)) return x === Infinity ? "infinite" : "not a number";
    const size = Math.abs(x);
    return x === 0 ? "0" : size >= 1e6 || size < 1e-3 ? x.toExponential(digits - 1) : String(Number(x.toPrecision(digits)));
  };
  const seconds = (s) => {
    const whole = Math.round(s);
    return whole < 60 ? `${s.toFixed(1)} s` : whole < 3600 ? `${Math.floor(whole / 60)} min ${String(whole % 60).padStart(2, "0")} s` : `${(s / 3600).toFixed(2)} h`;
  };
  const bytes = (n) => (n >= 2 ** 30 ? `${(n / 2 ** 30).toFixed(2)} GiB` : n >= 2 ** 20 ? `${(n / 2 ** 20).toFixed(1)} MiB` : `${(n / 1024).toFixed(0)} KiB`);

  // The head, warnings and tables need no library: they come first and stay, whatever fails later.

  byId("scan-line").textContent = scans.map((s) => s.line).join("; ");
  document.querySelector("h1").textContent = page.title;

  const warnings = byId("warnings");
  for (const w of page.warnings) {
    warnings.append(element("p", { class: "warning" }, w.found, ...(w.advice ? [element("br"), w.advice] : [])));
  }
  byId("warnings-section").hidden = page.warnings.length === 0;

  for (const run of runs.filter((r) => !r.record && page.renewed)) {
    const last = run.curves[run.curves.length - 1] ?? {};
    const status = [["step", last.step, String], ["after", last.seconds, seconds], ["loss", last.loss], ["PSNR", last.psnr, (x) => `${x.toFixed(2)} dB`], ["held-out error", last.held_out]];
    const known = status.filter(([, x]) => Number.isFinite(x)).map(([name, x, show = (x) => short(x, 4)]) => `${name} ${show(x)}`);
    byId("live").append(element("p", {}, known.join(" · ") || "Nothing recorded yet."));
    if (run.live) byId("live").append(element("img", { class: "picture", src: run.live, alt: "The middle slices" }));
  }
  byId("live-section").hidden = byId("live").childElementCount === 0;

  const scores = byId("scores");
  scores.append(row("th", ["", ...runs.map((r) => r.name)]));
  for (const [name, kind, pick] of [
    ["PSNR, dB", 5, (r) => r.scores && (r.scores.psnr ?? Infinity)], ["SSIM 2D", 4, (r) => r.scores?.ssim_2d], ["SSIM 3D", 4, (r) => r.scores?.ssim_3d],
    ["SSIM scikit-image", 4, (r) => r.scores?.ssim_skimage], ["RMSE", 5, (r) => r.scores?.rmse], ["peak (data range)", 5, (r) => r.scores && r.peak],
    ["held-out error", 4, (r) => r.held_out], ["last loss", 4, (r) => r.loss], ["steps or passes", 0, (r) => r.steps],
    ["solving", seconds, (r) => r.train_s], ["all", seconds, (r) => r.total_s], ["peak memory", bytes, (r) => r.peak_bytes],
    ["parameters", 0, (r) => r.parameters || null], ["seed", 0, (r) => r.seed], ["threads", 0, (r) => r.threads],
  ]) {
    const found = runs.map((r) => pick(r.record ?? {}));
    if (found.every((x) => x === null || x === undefined)) continue;
    const show = (x) => (x === null || x === undefined ? "-" : typeof kind === "function" ? kind(x) : kind === 0 ? String(x) : short(x, kind));
    scores.append(row("th", [name, ...found.map((x) => figure(show(x)))]));
  }
  const spreads = byId("spreads");
  const shown_figures = [["psnr", "PSNR, dB", 2], ["ssim_2d", "SSIM 2D", 4], ["ssim_3d", "SSIM 3D", 4], ["held_out", "held-out error", 5], ["train_s", "solving, s", 2], ["total_s", "all, s", 2]]
    .filter(([key]) => page.spreads.some((s) => s.figures[key]));
  if (page.spreads.length > 0) {
    spreads.append(row("th", ["mean ± standard deviation", "seeds", ...shown_figures.map(([, name]) => name)]));
    for (const { name, figures } of page.spreads) {
      const show = (s, digits) => (Number.isFinite(s?.mean) ? s.mean.toFixed(digits) + (s.sd === null ? "" : ` ± ${s.sd.toFixed(digits)}`) : "-");
      spreads.append(row("th", [name, figure(String(Math.max(0, ...Object.values(figures).map((s) => s.n)))), ...shown_figures.map(([key, , digits]) => figure(show(figures[key], digits)))]));
    }
  }
  for (const run of runs) {
    const parts = [["reading", "load_s"], ["preparing", "prepare_s"], ["solving", "train_s"], ["export", "export_s"], ["picture", "picture_s"], ["scores", "score_s"]];
    const known = parts.map(([name, key], i) => [name, run.record?.[key] ?? 0, page.colours[i]]).filter(([, s]) => s > 0);
    const all = known.reduce((sum, [, s]) => sum + s, 0);
    if (all === 0) continue;
    // Short parts have no room for their names in the bar: all names are above it.
    const bar = element("div", { class: "bar" }), names = element("p", {}, `${run.name}: `);
    for (const [name, s, colour] of known) {
      const [part, swatch] = [element("span", { title: `${name}: ${seconds(s)}` }), element("span", { class: "swatch" })];
      part.style.width = `${(100 * s) / all}%`;
      part.style.background = swatch.style.background = colour;
      bar.append(part);
      names.append(element("span", { class: "part" }, swatch, `${name} ${seconds(s)}`));
    }
    byId("times").append(element("div", { class: "bars" }, names, bar));
  }
  byId("scores-section").hidden = scores.childElementCount === 1 && page.spreads.length === 0 && byId("times").childElementCount === 0;

  for (const run of runs) {
    const plan = run.record?.plan;
    byId("method").append(
      element("h3", {}, run.name),
      element("p", { class: "note" }, `${run.folder}: ${run.status}`),
      ...(plan ? [element("p", {}, `Planned for a budget of ${seconds(run.record.budget_s ?? 0)}: ${plan.why}`)] : []),
      ...(run.plan ? [element("details", {}, element("summary", {}, "What the spec builds"), element("pre", {}, run.plan))] : []),
      element("details", {}, element("summary", {}, "Spec, with every setting"), element("pre", {}, run.spec)),
      ...(run.record ? [element("details", {}, element("summary", {}, "Record"), element("pre", {}, JSON.stringify(run.record, null, 2)))] : []),
    );
  }

  scans.forEach((scan) => {
    const pieces = [element("h3", {}, scan.line)];
    if (scan.geometry) pieces.push(element("img", { class: "picture", src: scan.geometry, alt: "Source path, detector and volume from above and from the side" }));
    if (scan.facts) pieces.push(element("details", {}, element("summary", {}, "Metadata of the scan"), element("pre", {}, scan.facts)));
    byId("geometry").append(...pieces);
  });
  byId("geometry-section").hidden = scans.every((s) => !s.geometry);

  // Projections: one view at a time, measured on the left, beside it every run's prediction and residual.
  scans.forEach((scan, at) => {
    const projected = runs.filter((r) => r.scan === at && r.views);
    if (scan.views.length === 0 || projected.length === 0) return;
    const pick = element("select", {});
    scan.views.forEach((v, i) => pick.append(element("option", { value: i }, v.held_out ? `${v.view} (held out)` : String(v.view))));
    const slider = element("input", { type: "range", min: 0, max: scan.views.length - 1, value: 0, "aria-label": "view" });
    const shown = element("div", { class: "views" });
    const picture = (src, ...caption) => element("figure", {}, element("img", { src, alt: "" }), element("figcaption", {}, ...caption));
    const show = (i) => {
      pick.value = slider.value = i;
      const measured = scan.views[i];
      shown.replaceChildren(...projected.map((run) => {
        const view = run.views.images[i];
        return element("div", {}, element("h3", {}, run.name), element("div", { class: "row" },
          picture(measured.measured, `measured, black ${short(scan.window[0], 3)} to white ${short(scan.window[1], 3)}`),
          picture(view.predicted, "predicted, the same scale"),
          picture(view.residual, `measured minus predicted: blue ${short(-scan.residual_span, 3)} to red ${short(scan.residual_span, 3)}, root mean square ${short(view.rms, 3)}`)));
      }));
    };
    pick.addEventListener("change", () => show(Number(pick.value)));
    slider.addEventListener("input", () => show(Number(slider.value)));
    byId("views").append(
      element("p", {}, `${scan.name}: line integrals in ${scan.views.length} of ${scan.count} views. `, element("label", {}, "View ", pick, " ", slider)),
      ...projected.map((r) => element("p", { class: "note" }, `${r.name}: measured minus predicted in these views, root mean square ${short(r.views.rms, 4)}, ${short(r.views.relative, 4)} of the largest line integral; projector ${r.views.projector}`)),
      shown);
    show(0);
  });
  byId("views-section").hidden = byId("views").childElementCount === 0;

  for (const line of page.notes) byId("about").append(element("p", { class: "note" }, line));
  byId("about").append(element("details", {}, element("summary", {}, "Licences of the libraries in this page"), element("pre", {}, page.licences)));

  // Curves.
  const plots = [["loss", "loss", true], ["psnr", "PSNR, dB", false], ["held_out", "held-out error", false], ["lr", "learning rate", true]];
  function curves() {
    const against = byId("against").value;
    byId("curves").replaceChildren();
    const drawn_plots = [];
    for (const [key, title, logarithmic] of plots) {
      const drawn = runs.map((run, i) => {
        const points = (run.curves ?? []).filter((p) => Number.isFinite(p[key]) && Number.isFinite(p[against]) && (!logarithmic || p[key] > 0));
        return { name: run.name, colour: page.colours[i % page.colours.length], points };
      }).filter((s) => s.points.length > 0);
      if (drawn.length === 0) continue;
      const data = uPlot.join(drawn.map((s) => [s.points.map((p) => p[against]), s.points.map((p) => p[key])]));
      const box = element("div", { class: "plot" });
      byId("curves").append(box);
      drawn_plots.push((width) => new uPlot({
        title, width, height: 300,
        scales: { x: { time: false }, y: logarithmic ? { distr: 3 } : {} },
        axes: [{ label: against === "seconds" ? "solve time, s" : "steps or passes" }, { size: 70, values: (_, all) => all.map((x) => (x === null ? "" : short(x, 3))) }],
        series: [
          { label: against === "seconds" ? "s" : "step", value: (_, x) => short(x) },
          ...drawn.map((s) => ({ label: s.name, stroke: s.colour, width: 2, spanGaps: true, points: { show: s.points.length < 30 }, value: (_, x) => short(x) })),
        ],
      }, data, box));
    }
    // Boxes share a row: each has its final width from the start.
    const widths = Array.from(byId("curves").children, (box) => Math.max(300, box.clientWidth - 4));
    drawn_plots.forEach((draw, i) => draw(widths[i]));
    byId("curves-section").hidden = byId("curves").childElementCount === 0;
  }
  byId("against").addEventListener("change", curves);
  for (const run of runs) {
    const events = (run.curves ?? []).flatMap((p) => (p.events ?? []).map((e) => `step ${p.step}: ${e}`));
    if (events.length > 0) byId("events").append(element("details", {}, element("summary", {}, `${run.name}: ${events.length} events`), element("pre", {}, events.join("\n"))));
  }
  let resized;
  window.addEventListener("resize", () => { clearTimeout(resized); resized = setTimeout(curves, 200); });
  curves();

  // The page of an unfinished run requests a newer one and keeps open sections open. Without an answer it stays.
  if (page.renewed) {
    const kept = JSON.parse(sessionStorage.getItem("kept") ?? "{}");
    for (const summary of document.querySelectorAll("summary")) summary.parentElement.open = (kept.open ?? []).includes(summary.textContent);
    if (kept.against) byId("against").value = kept.against;
    curves();
    const status = (text) => { byId("live-note").textContent = text; };
    status(`State at ${new Date().toLocaleTimeString()}, updated every ${page.renewed} s.`);
    const renew = async () => {
      try {
        if (!(await fetch(location.href, { cache: "no-store" })).ok) throw new Error("refused");
        const open = Array.from(document.querySelectorAll("details[open] > summary"), (s) => s.textContent);
        sessionStorage.setItem("kept", JSON.stringify({ open, against: byId("against").value }));
        location.reload();
      } catch {
        status("The run has ended or was stopped. This is its last state; conefield report shows the result.");
        setTimeout(renew, 1000 * page.renewed);
      }
    };
    setTimeout(renew, 1000 * page.renewed);
  }

  // Volumes.
  byId("volumes-section").hidden = volumes.length === 0;
  for (const link of document.querySelectorAll("nav a")) link.hidden = document.querySelector(link.hash).hidden;
  if (volumes.length === 0) return;

  /** The stored integers of a volume, decoded once, x fastest. */
  const decoded = new Map();
  async function stored(index) {
    if (!decoded.has(index)) {
      const packed = Uint8Array.from(atob(byId(`volume-${index}`).textContent), (c) => c.charCodeAt(0));
      const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
      const raw = new Uint8Array(await new Response(stream).arrayBuffer());
      // The high bytes of all voxels come before the low ones.
      const n = raw.length / 2, values = new Int16Array(n);
      for (let i = 0; i < n; i++) values[i] = (raw[i] << 8) | raw[n + i];
      decoded.set(index, values);
    }
    return decoded.get(index);
  }
  const NO_NUMBER = -32768;
  const real = (volume, x) => (x === NO_NUMBER ? NaN : x * volume.slope + volume.offset);
  const same = (a, b) => a.shape.every((n, k) => n === b.shape[k]) && a.spacing.every((s, k) => Math.abs(s - b.spacing[k]) <= 1e-6 * s);

  /** The difference of two volumes, and a bound of all but half a percent of it; the last two are cached, one per canvas. */
  const differences = new Map();
  async function difference(a, b) {
    const name = `${a},${b}`;
    if (!differences.has(name)) {
      const [x, y] = [await stored(a), await stored(b)], values = new Float32Array(x.length);
      for (let i = 0; i < x.length; i++) values[i] = real(volumes[a], x[i]) - real(volumes[b], y[i]);
      const some = values.filter((v, i) => i % Math.ceil(values.length / 100000) === 0 && Number.isFinite(v)).map(Math.abs).sort();
      differences.set(name, { values, span: some[Math.floor(0.995 * (some.length - 1))] || 1 });
      if (differences.size > 2) differences.delete(differences.keys().next().value);
    }
    return differences.get(name);
  }

  /** A volume as a NIfTI-1 file for the viewer, positioned in the scan's millimetres. */
  function nifti(volume, values) {
    const floats = values instanceof Float32Array;
    const buffer = new ArrayBuffer(352 + values.byteLength), view = new DataView(buffer);
    view.setInt32(0, 348, true);
    [3, ...volume.shape, 1, 1, 1, 1].forEach((n, i) => view.setInt16(40 + 2 * i, n, true));
    view.setInt16(70, floats ? 16 : 4, true);
    view.setInt16(72, floats ? 32 : 16, true);
    [1, ...volume.spacing, 1, 1, 1, 1].forEach((x, i) => view.setFloat32(76 + 4 * i, x, true));
    view.setFloat32(108, 352, true);
    view.setFloat32(112, floats ? 1 : volume.slope, true);
    view.setFloat32(116, floats ? 0 : volume.offset, true);
    view.setUint8(123, 2);
    view.setInt16(254, 1, true);
    volume.spacing.forEach((s, k) => {
      view.setFloat32(280 + 16 * k + 4 * k, s, true);
      view.setFloat32(280 + 16 * k + 12, first(volume, k), true);
    });
    [0x6e, 0x2b, 0x31, 0].forEach((c, i) => view.setUint8(344 + i, c));
    (floats ? new Float32Array(buffer, 352) : new Int16Array(buffer, 352)).set(values);
    return buffer;
  }
  /** The centre of the first voxel along axis k, mm. */
  const first = (volume, k) => volume.center[k] - (volume.shape[k] - 1) * volume.spacing[k] / 2;

  const state = { show: 0, minus: -1, beside: page.beside ?? -1, window: [...volumes[0].window], span: null, usual: 1, at: null };
  for (const [key, value] of new URLSearchParams(location.hash.slice(1))) {
    const numbers = value.split(",").map(Number);
    if (!numbers.every(Number.isFinite)) continue;
    if (["show", "minus", "beside"].includes(key) && numbers[0] < volumes.length && Number.isInteger(numbers[0])) state[key] = numbers[0];
    if (key === "window" && numbers.length === 2 && numbers[0] < numbers[1]) state.window = numbers;
    if (key === "at" && numbers.length === 3) state.at = numbers;
  }
  if (state.show < 0) state.show = 0;

  volumes.forEach((v, i) => {
    byId("show").append(element("option", { value: i }, v.name));
    byId("beside").append(element("option", { value: i }, v.name));
    byId("minus").append(element("option", { value: i }, v.name));
  });
  byId("beside").prepend(element("option", { value: -1 }, "nothing"));
  byId("minus").prepend(element("option", { value: -1 }, "nothing"));

  // Windows. Hounsfield units are linear in attenuation: HU = 1000 (μ/μ_water − 1).
  const low = Math.min(...volumes.map((v) => v.low)), high = Math.max(...volumes.map((v) => v.high));
  const unit = volumes[0].unit;
  byId("water").value = Number(volumes[0].water.toPrecision(4));
  byId("water").addEventListener("change", () => { if (state.at) moved(state.at); });
  byId("water-label").append(` ${unit}`);
  const hounsfield = (level, width) => () => [level - width / 2, level + width / 2].map((h) => Number(byId("water").value) * (1 + h / 1000));
  const presets = [
    ["automatic", () => volumes[state.show].window], ["full", () => [low, high]],
    ["lung", hounsfield(-600, 1500)], ["soft tissue", hounsfield(40, 400)], ["bone", hounsfield(400, 1800)],
  ];
  for (const [name, window] of presets) {
    const button = element("button", { type: "button" }, name);
    button.addEventListener("click", () => {
      if (state.minus >= 0) state.span = name === "full" ? Math.max(Math.abs(low), Math.abs(high), high - low) : null;
      else state.window = window();
      rewindow();
    });
    byId("presets").append(button, " ");
  }
  const range = { level: [low, high], width: [(high - low) / 1000, 1.5 * (high - low)] };
  for (const name of ["level", "width"]) {
    const slider = byId(`${name}-slider`);
    [slider.min, slider.max] = range[name];
    slider.step = (range[name][1] - range[name][0]) / 1000 || 1;
    for (const input of [byId(name), slider]) {
      input.addEventListener(input === slider ? "input" : "change", () => {
        const value = Number(input.value);
        if (!Number.isFinite(value) || (name === "width" && value <= 0)) return rewindow();
        let [level, width] = [(state.window[0] + state.window[1]) / 2, state.window[1] - state.window[0]];
        if (state.minus >= 0) state.span = name === "width" ? value / 2 : state.span;
        else {
          if (name === "level") level = value;
          else width = value;
          state.window = [level - width / 2, level + width / 2];
        }
        rewindow();
      });
    }
  }

  /** The range of the colour map, of values or of a difference. */
  const windowOf = (minus) => (minus < 0 ? state.window : [-(state.span ?? state.usual), state.span ?? state.usual]);

  function showWindow() {
    const [a, b] = windowOf(state.minus);
    for (const [name, value] of [["level", (a + b) / 2], ["width", b - a]]) {
      byId(name).value = Number(value.toPrecision(5));
      byId(`${name}-slider`).value = value;
      byId(name).disabled = byId(`${name}-slider`).disabled = name === "level" && state.minus >= 0;
    }
  }

  /** A canvas with its viewer. */
  class Pane {
    constructor(canvas) {
      this.nv = new niivue.Niivue({
        backColor: [0, 0, 0, 1], crosshairColor: [0.95, 0.75, 0.1, 0.8], crosshairWidth: 0.35, crosshairWidthUnit: "percent", show3Dcrosshair: true, isColorbar: true,
        isOrientationTextVisible: false, dragAndDropEnabled: false, isNearestInterpolation: true, multiplanarShowRender: 1,
        loadingText: "", logLevel: "warn", isRadiologicalConvention: false, sagittalNoseLeft: false, tileMargin: 4,
      });
      this.canvas = canvas;
      this.minus = -1;
      this.shown = "";
    }
    async attach() {
      await this.nv.attachToCanvas(this.canvas);
      this.nv.addColormap("difference", page.diverging);
      this.nv.onLocationChange = (place) => moved(place.mm);
      this.nv.onIntensityChange = (image) => {
        if (this.minus < 0) state.window = [image.cal_min, image.cal_max];
        else state.span = Math.max(Math.abs(image.cal_min), Math.abs(image.cal_max));
        rewindow();
      };
      return this;
    }
    /** Shows volume `index`, minus volume `minus` unless that is -1. */
    async show(index, minus) {
      const name = `${index},${minus}`;
      this.minus = minus;
      if (this.shown !== name) {
        const volume = volumes[index];
        const values = minus < 0 ? await stored(index) : (await difference(index, minus)).values;
        const image = await niivue.NVImage.new(nifti(volume, values), "volume.nii", minus < 0 ? "gray" : "difference", 1, null, ...windowOf(minus));
        while (this.nv.volumes.length > 0) this.nv.removeVolume(this.nv.volumes[0]);
        this.nv.addVolume(image);
        this.shown = name;
      }
      this.window();
    }
    /** A description of the content of the canvas. */
    caption() {
      const [index, minus] = this.shown.split(",").map(Number);
      return volumes[index].name + (minus < 0 ? "" : ` minus ${volumes[minus].name}`);
    }
    window() {
      const image = this.nv.volumes[0];
      if (!image) return;
      [image.cal_min, image.cal_max] = windowOf(this.minus);
      this.nv.updateGLVolume();
    }
    /** Moves the crosshair to `mm`. */
    go(mm) {
      this.nv.scene.crosshairPos = this.nv.mm2frac(mm);
      this.nv.drawScene();
    }
    layout() {
      const how = byId("layout").value;
      this.nv.setSliceType({ all: 3, axial: 0, coronal: 1, sagittal: 2, rendering: 4 }[how]);
    }
  }

  /** The voxel of `volume` at `mm`, or null outside. */
  function voxel(volume, mm) {
    const at = [0, 1, 2].map((k) => Math.round((mm[k] - first(volume, k)) / volume.spacing[k]));
    return at.every((i, k) => i >= 0 && i < volume.shape[k]) ? at : null;
  }
  async function value(index, at) {
    const { shape } = volumes[index];
    return real(volumes[index], (await stored(index))[at[0] + shape[0] * (at[1] + shape[1] * at[2])]);
  }

  /** Shows the values at the crosshair, which is now at `mm`. */
  let asked = 0;
  async function moved(mm) {
    const mine = ++asked;
    mm = Array.from(mm).slice(0, 3);
    const at = voxel(volumes[state.show], mm);
    const rows = [];
    for (let i = 0; i < volumes.length; i++) {
      const here = voxel(volumes[i], mm);
      // Volumes that have not been shown yet stay packed.
      const known = decoded.has(i) || volumes.length <= 6;
      const found = here && known ? await value(i, here) : undefined;
      rows.push([volumes[i], found]);
    }
    if (mine !== asked) return;
    state.at = mm;
    const coarser = volumes[state.show].coarser;
    const voxels = at?.map((i) => (coarser === 1 ? i : `${i * coarser}–${i * coarser + coarser - 1}`)).join(", ");
    byId("place").textContent = `Crosshair at x ${mm[0].toFixed(2)}, y ${mm[1].toFixed(2)}, z ${mm[2].toFixed(2)} mm` + (at ? `, voxel ${voxels}` : "");
    const base = state.minus >= 0 ? rows[state.minus][1] : undefined;
    const water = Number(byId("water").value), hu = (x) => (x === undefined || !(water > 0) ? "-" : String(Math.round(1000 * (x / water - 1))));
    byId("values").replaceChildren(row("th", ["volume", `value, ${unit}`, "HU, water as above", ...(base !== undefined ? [`less ${volumes[state.minus].name}`] : [])]),
      ...rows.map(([v, x], i) => {
        const cell = figure(x === undefined ? "-" : short(x));
        cell.dataset.volume = i;
        cell.dataset.value = x;
        return row("td", [v.name, cell, figure(hu(x)), ...(base !== undefined ? [figure(x === undefined ? "-" : short(x - base))] : [])]);
      }));
    remember();
  }

  let later;
  function remember() {
    clearTimeout(later);
    later = setTimeout(() => {
      const parts = { show: state.show, minus: state.minus, beside: state.beside, window: state.window.map((x) => Number(x.toPrecision(6))), at: state.at?.map((x) => Number(x.toPrecision(6))) ?? null };
      const text = Object.entries(parts).filter(([, v]) => v !== null).map(([k, v]) => `${k}=${[v].flat().join(",")}`).join("&");
      try { history.replaceState(null, "", `#${text}`); } catch { /* The address may be read-only. */ }
    }, 200);
  }

  let first_pane, second_pane;
  const panes = () => [first_pane, state.beside >= 0 ? second_pane : null].filter(Boolean);

  let frame;
  function rewindow() {
    showWindow();
    cancelAnimationFrame(frame);
    frame = requestAnimationFrame(() => { panes().forEach((p) => p.window()); remember(); });
  }

  /** Updates both canvases to `state`, one call at a time. */
  let work = Promise.resolve();
  const display = () => (work = work.then(draw, draw));
  async function draw() {
    const comparable = (i) => i >= 0 && i !== state.show && same(volumes[i], volumes[state.show]);
    if (!comparable(state.minus)) state.minus = -1;
    for (const option of byId("minus").options) option.disabled = Number(option.value) >= 0 && !comparable(Number(option.value));
    for (const name of ["show", "minus", "beside"]) byId(name).value = state[name];
    if (state.minus >= 0) state.usual = (await difference(state.show, state.minus)).span;
    byId("second").hidden = state.beside < 0;
    if (state.beside >= 0 && !second_pane) {
      second_pane = await new Pane(byId("canvas-beside")).attach();
      second_pane.nv.broadcastTo([first_pane.nv], { "2d": true, "3d": true });
      first_pane.nv.broadcastTo([second_pane.nv], { "2d": true, "3d": true });
    }
    await first_pane.show(state.show, state.minus);
    if (state.beside >= 0) await second_pane.show(state.beside, state.minus >= 0 && state.minus !== state.beside && same(volumes[state.beside], volumes[state.minus]) ? state.minus : -1);
    byId("shown").textContent = first_pane.caption();
    if (state.beside >= 0) byId("shown-beside").textContent = second_pane.caption();
    const shown = volumes[state.show];
    byId("volume-note").textContent = `${shown.name}: ${shown.note}`;
    showWindow();
    const mm = state.at ?? shown.shape.map((n, k) => first(shown, k) + Math.floor(n / 2) * shown.spacing[k]);
    panes().forEach((p) => { p.layout(); p.go(mm); });
    await moved(mm);
  }

  if (!document.createElement("canvas").getContext("webgl2")) {
    byId("no-webgl").hidden = false;
    byId("no-webgl").textContent = "This browser does not support WebGL 2, which is needed to draw the volumes. The rest of the page works without it.";
    byId("canvases").hidden = true;
    return;
  }
  first_pane = await new Pane(byId("canvas")).attach();
  for (const name of ["show", "minus", "beside"]) {
    byId(name).addEventListener("change", () => { state[name] = Number(byId(name).value); if (name !== "beside") state.span = null; display(); });
  }
  byId("layout").addEventListener("change", () => panes().forEach((p) => p.layout()));
  byId("smooth").addEventListener("change", () => panes().forEach((p) => p.nv.setInterpolation(!byId("smooth").checked)));
  let last_minus = volumes.findIndex((v) => v.reference);
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input[type=number]")) return;
    if (/^[1-9]$/.test(event.key) && Number(event.key) <= volumes.length) { state.show = Number(event.key) - 1; display(); }
    if (event.key === "d") {
      if (state.minus >= 0) [last_minus, state.minus] = [state.minus, -1];
      else state.minus = last_minus === state.show ? -1 : last_minus;
      state.span = null;
      display();
    }
  });
  await display();
  document.body.dataset.ready = "yes";
})().catch((error) => {
  const place = document.getElementById("no-webgl");
  place.hidden = false;
  place.textContent = `The volumes could not be drawn: ${error.message ?? error}`;
  document.body.dataset.ready = "failed";
});

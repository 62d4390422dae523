"use strict";
// The fleet report: unpacks the columns of its vehicles, draws figures when they come into sight, filters and sorts.
(() => {
  const facts = JSON.parse(document.getElementById("facts").textContent);
  const K = facts.branches.length, N = facts.vehicles;
  const MISSING = -2147483648, ROWS = 50;
  const $ = (id) => document.getElementById(id);
  const CONFIG = { responsive: true, displayModeBar: false };
  const BEFORE = "#D55E00", AFTER = "#0072B2", IDEAL = "#1b1f24";

  // ---- packed data ---------------------------------------------------------------------------------------------
  async function unpack(id) {
    const text = atob($(id).textContent.trim());
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).arrayBuffer();
  }

  async function unpackColumns(id, about) {
    const bytes = new Uint8Array(await unpack(id)), found = {};
    let start = 0;
    for (const { name, step, length } of about) {
      const values = new Float64Array(length);
      for (let i = 0; i < length; i++) {
        const at = start + i;
        const whole = bytes[at] | (bytes[at + length] << 8) | (bytes[at + 2 * length] << 16) | (bytes[at + 3 * length] << 24);
        values[i] = whole === MISSING ? NaN : whole * step;
      }
      found[name] = values;
      start += 4 * length;
    }
    return found;
  }

  const unpackJson = async (id) => JSON.parse(new TextDecoder().decode(await unpack(id)));

  let plotly = null;
  function loadPlotly() {
    plotly ??= unpack("plotly").then((content) => {
      const script = document.createElement("script");
      script.textContent = new TextDecoder().decode(content);
      document.head.append(script);
      return window.Plotly;
    });
    return plotly;
  }

  let details = null;
  const loadDetails = () => (details ??= Promise.all([unpackJson("details"), unpackColumns("evidence", facts.evidence_columns)])
    .then(([texts, evidence]) => ({ ...texts, evidence: inUnits(evidence) })));

  function inUnits(evidence) {
    const steps = facts.evidence_steps;
    for (const values of Object.values(evidence)) for (let i = 0; i < values.length; i++) values[i] *= steps[i % steps.length];
    return evidence;
  }

  // ---- words ---------------------------------------------------------------------------------------------------
  const fixed = (value, digits, unit, sign) => Number.isNaN(value) || value === undefined ? "–"
    : `${sign && value >= 0 ? "+" : ""}${value.toFixed(digits).replace("-", "−")}${unit}`;
  const amperes = (value, sign = false) => fixed(value, 2, " A", sign);
  const percent = (value, digits = 2, sign = false) => fixed(100 * value, digits, " %", sign);
  const withSd = (value, sd, unit, factor = 1) =>
    (value === 0 ? "0" : fixed(factor * value, 2, "", true)) + (Number.isNaN(sd) ? "" : ` ± ${(factor * sd).toFixed(2)}`) + unit;

  function element(tag, attributes = {}, ...children) {
    const made = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) {
      if (name === "onclick") made.addEventListener("click", value);
      else if (value !== null) made.setAttribute(name, value);
    }
    made.append(...children);
    return made;
  }

  function table(head, rows, caption) {
    const texts = new Set(head.flatMap((cell, i) => (cell.startsWith("<") ? [i] : [])));
    const cells = (tag, row) => row.map((cell, i) => element(tag, { class: texts.has(i) ? "wide" : null }, cell));
    return element("div", { class: "scroll" }, element("table", {},
      ...(caption ? [element("caption", {}, caption)] : []),
      element("thead", {}, element("tr", {}, ...cells("th", head.map((cell) => cell.replace("<", ""))))),
      element("tbody", {}, ...rows.map((row) => element("tr", {}, ...cells("td", row))))));
  }

  function fail(error) {
    $("failure").hidden = false;
    $("failure").textContent = `This page could not be set up: ${error.message ?? error}. `
      + "It needs a browser of 2023 or later (Chrome, Edge, Firefox 113, Safari 16.4).";
    document.body.dataset.failed = "true";
  }

  // ---- figures -------------------------------------------------------------------------------------------------
  function drawWhenSeen() {
    const watch = new IntersectionObserver((entries) => {
      for (const { isIntersecting, target } of entries) {
        if (!isIntersecting) continue;
        watch.unobserve(target);
        draw(target, facts.figures[target.dataset.figure]).catch(fail);
      }
    }, { rootMargin: "400px" });
    for (const place of document.querySelectorAll("[data-figure]")) watch.observe(place);
    window.addEventListener("beforeprint", () => {
      for (const place of document.querySelectorAll("[data-figure]:empty")) draw(place, facts.figures[place.dataset.figure]);
    });
  }

  async function draw(place, figure) {
    const Plotly = await loadPlotly();
    await Plotly.newPlot(place, figure.data, figure.layout, CONFIG);
    place.dataset.drawn = "true";
  }

  // ---- the table of vehicles -----------------------------------------------------------------------------------
  function listing(names, columns) {
    const largest = new Float64Array(N), kinds = facts.verdicts;
    for (let j = 0; j < N; j++) {
      for (let k = 0; k < K; k++) {
        const i = j * K + k;
        largest[j] = Math.max(largest[j], Math.abs(columns.drift[i]) * facts.full_scale_a + Math.abs(columns.offset_a[i]));
      }
    }
    const corrected = (j) => facts.branches.filter((_, k) => columns.applied[j * K + k] === 1
      && (columns.drift[j * K + k] !== 0 || columns.offset_a[j * K + k] !== 0)).join(", ");
    const number = (values) => (a, b) => (Number.isNaN(values[a]) ? 1 : 0) - (Number.isNaN(values[b]) ? 1 : 0) || values[a] - values[b];
    const collator = new Intl.Collator("en", { numeric: true });
    let place = null;
    const alphabet = () => {
      if (place === null) {
        place = new Uint32Array(N);
        Array.from(names.keys()).sort((a, b) => collator.compare(names[a], names[b])).forEach((j, rank) => { place[j] = rank; });
      }
      return place;
    };
    const heads = [
      { title: "vehicle", text: (j) => names[j], order: (a, b) => alphabet()[a] - alphabet()[b] },
      { title: "verdict", text: (j) => kinds[columns.verdict[j]], order: number(columns.verdict), words: true },
      { title: "confidence", text: (j) => percent(columns.confidence[j], 1), order: number(columns.confidence), down: true },
      { title: "sum before", text: (j) => amperes(columns.measured_a[j]), order: number(columns.measured_a), down: true },
      { title: "sum after", text: (j) => amperes(columns.deployed_a[j]), order: number(columns.deployed_a), down: true },
      { title: "largest fault", text: (j) => amperes(largest[j]), order: number(largest), down: true },
      { title: "corrected", text: corrected, order: null, words: true },
      { title: "hardware fault", text: (j) => percent(columns.hardware_probability[j], 1), order: number(columns.hardware_probability), down: true },
      { title: "drives", text: (j) => fixed(columns.duration_s[j] / 60, 1, " min"), order: number(columns.duration_s), down: true },
    ];
    if (columns.beside_a) {
      heads.splice(5, 0, { title: `sum after, ${facts.beside}`, text: (j) => amperes(columns.beside_a[j]), order: number(columns.beside_a), down: true });
    }
    return { heads, corrected };
  }

  function vehicles(names, columns) {
    const { heads, corrected } = listing(names, columns);
    const lower = names.map((name) => name.toLowerCase());
    let shown = [], page = 0, sorted = 5 + (columns.beside_a ? 1 : 0), descending = true;

    for (const kind of facts.verdicts) $("verdict").append(element("option", { value: kind }, kind));
    const buttons = heads.map((head, i) => head.order
      ? element("button", { type: "button", onclick: () => sortBy(i) }, head.title) : document.createTextNode(head.title));
    const headers = heads.map((head, i) => element("th", { scope: "col", class: head.words ? "text" : null }, buttons[i]));
    $("table").tHead.append(element("tr", {}, ...headers));

    function sortBy(i) {
      descending = i === sorted ? !descending : Boolean(heads[i].down);
      sorted = i;
      refresh();
    }

    function refresh() {
      const wanted = $("find").value.trim().toLowerCase(), kind = facts.verdicts.indexOf($("verdict").value);
      const suspected = $("suspected").checked, only = $("only-corrected").checked;
      shown = [];
      for (let j = 0; j < N; j++) {
        if (wanted && !lower[j].includes(wanted)) continue;
        if (kind >= 0 && columns.verdict[j] !== kind) continue;
        if (suspected && columns.suspected[j] !== 1) continue;
        if (only && columns.corrected[j] !== 1) continue;
        shown.push(j);
      }
      const order = heads[sorted].order;
      shown.sort(descending ? (a, b) => (order(b, a)) || a - b : (a, b) => order(a, b) || a - b);
      page = 0;
      headers.forEach((header, i) => i === sorted
        ? header.setAttribute("aria-sort", descending ? "descending" : "ascending") : header.removeAttribute("aria-sort"));
      turn(0);
    }

    function turn(by) {
      const pages = Math.max(1, Math.ceil(shown.length / ROWS));
      page = Math.min(Math.max(page + by, 0), pages - 1);
      const rows = shown.slice(page * ROWS, (page + 1) * ROWS).map((j) => element("tr", {}, ...heads.map((head, i) =>
        element("td", { class: head.words ? "text" : null },
          i ? head.text(j) : element("button", { type: "button", onclick: () => show(j, names, columns, true) }, names[j])))));
      $("table").tBodies[0].replaceChildren(...rows);
      $("count").textContent = `${shown.length.toLocaleString("en")} of ${N.toLocaleString("en")} vehicles`;
      $("page").textContent = `page ${page + 1} of ${pages}`;
      $("previous").disabled = page === 0;
      $("next").disabled = page === pages - 1;
    }

    function save() {
      const quoted = (text) => `"${String(text).replaceAll('"', '""')}"`;
      const per = facts.branches.flatMap((name) => [`${name} drift`, `${name} offset_a`, `${name} applied`]);
      const lines = [["vehicle", "verdict", "confidence", "junction_rms_measured_a", "junction_rms_deployed_a", "hardware_probability", ...per].map(quoted).join(",")];
      const plain = (value, digits) => (Number.isNaN(value) ? "" : value.toFixed(digits));
      for (const j of shown) {
        const own = facts.branches.flatMap((_, k) => [plain(columns.drift[j * K + k], 5), plain(columns.offset_a[j * K + k], 3), columns.applied[j * K + k]]);
        lines.push([quoted(names[j]), quoted(facts.verdicts[columns.verdict[j]]), plain(columns.confidence[j], 4), plain(columns.measured_a[j], 3), plain(columns.deployed_a[j], 3), plain(columns.hardware_probability[j], 4), ...own].join(","));
      }
      const link = element("a", { download: "vehicles.csv", href: URL.createObjectURL(new Blob([`${lines.join("\n")}\n`], { type: "text/csv" })) });
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
    }

    let waiting = 0;
    const soon = () => { clearTimeout(waiting); waiting = setTimeout(refresh, 120); };
    $("find").addEventListener("input", soon);
    for (const id of ["verdict", "suspected", "only-corrected"]) $(id).addEventListener("change", refresh);
    $("previous").addEventListener("click", () => turn(-1));
    $("next").addEventListener("click", () => turn(1));
    $("save").addEventListener("click", save);
    refresh();
    const follow = () => {
      const asked = location.hash.match(/^#vehicle=(.*)$/);
      const j = asked ? names.findIndex((name) => asked[1] === name || asked[1] === encodeURIComponent(name)) : -1;
      if (j >= 0) show(j, names, columns, true);
    };
    window.addEventListener("hashchange", follow);
    follow();
    return corrected;
  }

  // ---- one vehicle ---------------------------------------------------------------------------------------------
  async function show(j, names, columns, move) {
    const place = $("vehicle"), found = await loadDetails(), told = j < facts.told;
    const title = element("h3", { id: "vehicle-title" }, `Vehicle ${names[j]}`);
    const parts = [title, element("p", {}, sentence(j, columns))];
    parts.push(table(
      ["branch", "drift [%]", "offset [A]", "probability of a fault", "of harm", "<the node"],
      facts.branches.map((name, k) => {
        const i = j * K + k, faulty = columns.drift[i] !== 0 || columns.offset_a[i] !== 0;
        return [name, faulty ? withSd(columns.drift[i], columns.drift_sd[i], "", 100) : "0", faulty ? withSd(columns.offset_a[i], columns.offset_sd_a[i], "") : "0",
          percent(columns.fault_probability[i], 1), percent(columns.harm_probability[i], 2),
          columns.applied[i] === 1 && faulty ? "corrects" : faulty ? `passes through: ${facts.held_back[columns.held_back[i]] ?? "not applied"}` : "passes through"];
      })));
    if (columns.beside_drift) {
      parts.push(table(["branch", "drift [%]", "offset [A]"], facts.branches.map((name, k) => [name,
        fixed(100 * columns.beside_drift[j * K + k], 2, "", true), fixed(columns.beside_offset_a[j * K + k], 2, "", true)]), `Method ${facts.beside}`));
    }
    const currents = element("div", { class: "plot" }), evidence = element("div", { class: "plot" });
    const known = told && facts.evidence.length > 0 && !Number.isNaN(found.evidence.explained[j * facts.evidence.length]);
    if (facts.window && known) {
      parts.push(element("h4", {}, "Currents on the unity window, and their sum"), element("figure", {}, currents, element("figcaption", {},
        `${facts.window.seconds} s of the inputs of vehicle ${facts.window.vehicle}: what this vehicle's sensors show there by its own slopes and intercepts, corrected by what the node applies (of a sensor that is not linear by its linear part), and the ideal current of the fleet.`)));
    }
    if (known) {
      parts.push(element("h4", {}, "Evidence"), element("figure", {}, evidence, element("figcaption", {},
        "What the recordings say, with standard deviations, and what the estimate explains. Zero is a perfect vehicle; a load without a sensor moves the junction constant and an intercept of all.")));
    }
    const rivals = told ? found.explanations[j] : [];
    if (rivals.length) parts.push(element("h4", {}, rivals.length > 1 ? "Competing explanations" : "Explanation"), table(["probability", "<explanation"], rivals.map(([p, text]) => [percent(p, 1), text])));
    if (told && found.reasons[j]) parts.push(element("p", { class: "decides" }, `${found.reasons[j]}.`));
    if (known && !facts.window) parts.push(element("p", { class: "soft" }, "No currents are drawn: the result has no unity window."));
    if (told && !known) parts.push(element("p", { class: "soft" }, "No evidence was kept of this vehicle: its parameters are of an earlier run, or the method keeps none."));
    if (!told) parts.push(element("p", { class: "soft" }, "The evidence of this vehicle is not part of this page, which would be too large."));
    parts.push(element("p", { class: "soft" }, `Its own page, to print: calibrator report RESULT --vehicle "${names[j]}"`));
    place.replaceChildren(...parts);
    place.hidden = false;
    place.dataset.vehicle = names[j];
    if (move) place.scrollIntoView({ block: "start" }), place.focus({ preventScroll: true });
    if (!known) return;
    if (facts.window) await draw(currents, currentFigure(j, columns, found.evidence));
    await draw(evidence, evidenceFigure(j, found.evidence));
  }

  function sentence(j, columns) {
    const confidence = columns.confidence[j], hardware = columns.suspected[j] === 1;
    return `Verdict: ${facts.verdicts[columns.verdict[j]]}${Number.isNaN(confidence) ? "" : `, confidence ${percent(confidence, 1)}`}. `
      + `Kirchhoff sum ${amperes(columns.measured_a[j])} as measured, ${amperes(columns.deployed_a[j])} after correction (RMS over ${fixed(columns.duration_s[j] / 60, 1, " min")}). `
      + (columns.deployed_a[j] > columns.measured_a[j] && heldBack(j, columns) ? `The sum grows as a fault of ${heldBack(j, columns)} is held back. ` : "")
      + (hardware ? `A hardware fault is suspected, probability ${percent(columns.hardware_probability[j], 1)}: all currents ${percent(columns.hardware_drift[j], 2, true)}.` : "");
  }

  const heldBack = (j, columns) => facts.branches.filter((_, k) => !Number.isNaN(columns.held_back[j * K + k])).join(", ");

  function row(evidence, j, name) {
    const r = facts.evidence.indexOf(name), R = facts.evidence.length;
    const value = evidence.value[j * R + r];
    return Number.isNaN(value) ? evidence.explained[j * R + r] : value;
  }

  function currentFigure(j, columns, evidence) {
    const { time_s: time, ideal_a: ideal } = facts.window, data = [], layout = base(110 * (K + 1) + 90);
    const before = new Float64Array(time.length), after = new Float64Array(time.length);
    const trace = (y, name, color, axis, first, dash) => ({ type: "scatter", mode: "lines", x: time, y, name, legendgroup: name, showlegend: first,
      line: { color, width: 1.4, dash }, xaxis: "x", yaxis: `y${axis ? axis + 1 : ""}`, hovertemplate: `${name} %{y:.2f} A<extra></extra>` });
    facts.branches.forEach((name, k) => {
      const slope = row(evidence, j, `slope ${name}`), intercept = row(evidence, j, `intercept ${name}`), i = j * K + k;
      const applied = columns.applied[i] === 1;
      const measured = ideal[k].map((value) => (value === null ? null : slope * value + intercept));
      const corrected = measured.map((value) => (value === null || !applied ? value : (value - columns.offset_a[i]) / (1 + columns.drift[i])));
      measured.forEach((value, t) => { before[t] += value ?? NaN; after[t] += corrected[t] ?? NaN; });
      data.push(trace(measured, "measured", BEFORE, k, k === 0), trace(corrected, "corrected", AFTER, k, k === 0), trace(ideal[k], "ideal", IDEAL, k, k === 0, "dot"));
      layout[`yaxis${k ? k + 1 : ""}`] = { title: { text: `${name} [A]` }, ...grid() };
    });
    data.push(trace(Array.from(before), "measured", BEFORE, K, false), trace(Array.from(after), "corrected", AFTER, K, false));
    layout[`yaxis${K + 1}`] = { title: { text: "sum [A]" }, ...grid() };
    layout.xaxis = { title: { text: "time [s]" }, ...grid(), anchor: `y${K + 1}` };
    layout.grid = { rows: K + 1, columns: 1, subplots: Array.from({ length: K + 1 }, (_, k) => [`xy${k ? k + 1 : ""}`]), roworder: "top to bottom" };
    return { data, layout };
  }

  function evidenceFigure(j, evidence) {
    const R = facts.evidence.length, split = facts.ratios, data = [], layout = base(60 + 26 * R);
    const told = (from, to, axis, scale, shift) => {
      const rows = [];
      for (let r = from; r < to; r++) if (!Number.isNaN(evidence.value[j * R + r])) rows.push(r);
      const y = rows.map((r) => facts.evidence[r]);
      const of = (values, less) => rows.map((r) => scale * (values[j * R + r] - less));
      const own = { xaxis: `x${axis}`, yaxis: `y${axis}`, type: "scatter", mode: "markers", y };
      data.push({ ...own, name: "recordings", legendgroup: "r", showlegend: axis === "", x: of(evidence.value, shift), marker: { color: BEFORE, size: 7 },
        error_x: { type: "data", array: of(evidence.sd, 0), color: BEFORE }, hovertemplate: "%{y}: %{x:.3f}<extra>recordings</extra>" });
      data.push({ ...own, name: "explained", legendgroup: "e", showlegend: axis === "", x: of(evidence.explained, shift), marker: { color: AFTER, size: 11, symbol: "diamond-open" },
        hovertemplate: "%{y}: %{x:.3f}<extra>explained</extra>" });
      return y.length;
    };
    told(0, split, "", 100, 1);
    told(split, R, "2", 1, 0);
    layout.xaxis = { ...grid(), domain: [0.12, 0.46], title: { text: "gains: deviation from 1 [%]" } };
    layout.xaxis2 = { ...grid(), domain: [0.66, 1], title: { text: "constants [A]" }, anchor: "y2" };
    layout.yaxis = { ...grid(), autorange: "reversed" };
    layout.yaxis2 = { ...grid(), autorange: "reversed", anchor: "x2" };
    return { data, layout };
  }

  const grid = () => ({ gridcolor: "#e3e6ea", zerolinecolor: "#6b7682", automargin: true });
  const base = (height) => ({ height, margin: { l: 60, r: 15, t: 30, b: 45 }, paper_bgcolor: "white", plot_bgcolor: "white",
    font: { family: "system-ui, sans-serif", size: 12, color: "#1b1f24" }, legend: { orientation: "h", y: 1, yanchor: "bottom", x: 0 } });

  // ---- start ---------------------------------------------------------------------------------------------------
  async function start() {
    const [names, columns] = await Promise.all([unpackJson("names"), unpackColumns("columns", facts.columns)]);
    vehicles(names, columns);
    drawWhenSeen();
    await loadPlotly();
    document.body.dataset.ready = String(Math.round(performance.now()));
  }
  start().catch(fail);
})();

"use strict";
// The report: unpacks the columns of its vehicles, draws figures, filters, sorts, explains.
(() => {
  const $ = (id) => document.getElementById(id);
  const facts = JSON.parse($("facts").textContent);
  const K = facts.branches.length, R = facts.evidence.length;
  const ROWS = 50, PRINT_WIDTH = 680, UNKNOWN = "not known";
  const LEAST_RIVAL = 0.02, RESOLVED = 0.002, FITS = 3, MISFITS = 4;
  const BEFORE = "#D55E00", AFTER = "#0072B2", OTHER = "#767676", IDEAL = "#1b1f24"; // Okabe and Ito: also for colour-blind readers
  const RIVALS = "what it may be instead", MOST_BESIDE = 4; // panels in a row: more leave no room for titles

  // ---- compressed data -----------------------------------------------------------------------------------------
  async function unpack(id) {
    const text = atob($(`${id}-data`).textContent.trim()), bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip")));
  }

  const once = (load) => { let found = null; return () => (found ??= load()); };
  const loadPlotly = once(async () => {
    document.head.append(element("script", {}, await (await unpack("plotly")).text()));
    return window.Plotly;
  });
  const loadDetails = once(async () => (await unpack("details")).json());

  // Unknown numbers are null in JSON, and NaN here.
  async function loadColumns() {
    const columns = await (await unpack("columns")).json();
    for (const [name, values] of Object.entries(columns)) {
      if (["vehicle", "verdict", "held_back"].includes(name)) continue;
      const numbers = columns[name] = new Float64Array(values.length);
      for (let i = 0; i < values.length; i++) numbers[i] = values[i] ?? NaN; // a loop: ten times as fast as from()
    }
    return columns;
  }

  // ---- words and elements --------------------------------------------------------------------------------------
  function fixed(value, digits, unit, sign) {
    if (Number.isNaN(value) || value === undefined) return UNKNOWN;
    const rounded = Number(value.toFixed(digits)) + 0; // no -0
    return `${sign && rounded > 0 ? "+" : ""}${rounded.toFixed(digits).replace("-", "−")}${unit}`;
  }
  const amperes = (value, sign = false) => fixed(value, 2, " A", sign);
  const percent = (value, digits = 2, sign = false) => fixed(100 * value, digits, " %", sign);
  const probability = (p, digits = 1) => p >= 1 - 0.005 * 10 ** -digits ? `> ${(100 - 10 ** -digits).toFixed(digits)} %`
    : p < 0.005 * 10 ** -digits ? `< ${(10 ** -digits).toFixed(digits)} %` : percent(p, digits);

  function element(tag, attributes = {}, ...children) {
    const made = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) {
      if (name === "onclick") made.addEventListener("click", value);
      else if (value !== null) made.setAttribute(name, value);
    }
    made.append(...children);
    return made;
  }

  // A heading that begins with < marks a column of text; the last cell of a short row spans the remaining columns.
  function table(head, rows) {
    const cells = (tag, row) => row.map((cell, i) => element(tag, { class: head[i].startsWith("<") ? "wide" : null,
      colspan: i === row.length - 1 && row.length < head.length ? head.length - i : null }, cell));
    return element("div", { class: "scroll" }, element("table", {},
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
  const AXIS = { gridcolor: "#e3e6ea", zerolinecolor: "#9aa3ad", automargin: true };
  const BASE = { margin: { l: 55, r: 15, t: 25, b: 45 }, paper_bgcolor: "white", plot_bgcolor: "white",
    font: { family: "system-ui, sans-serif", size: 12, color: "#1b1f24" }, legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 } };

  // Two panels: beside each other, or on a phone one above the other.
  const NARROW = document.documentElement.clientWidth < 600;
  const panel = (side) => (NARROW ? { x: [0, 1], y: side ? [0, 0.38] : [0.62, 1] } : { x: side ? [0.52, 1] : [0, 0.48], y: [0, 1] });
  const panelsHeight = (rows) => (NARROW ? 200 + 2 * rows : 90 + rows);

  async function draw(place, { data, layout }) {
    const Plotly = await loadPlotly(), whole = { ...BASE, xaxis: {}, yaxis: {}, ...layout };
    if (NARROW && layout.grid) Object.assign(whole, { grid: { ...layout.grid, rows: K, columns: 1 }, height: 280 * K });
    for (const name of Object.keys(whole)) if (/^[xy]axis/.test(name)) whole[name] = { ...AXIS, ...whole[name] };
    await Plotly.newPlot(place, data, whole, { responsive: true, displayModeBar: false });
    place.dataset.drawn = "true";
  }

  // Distributions of the Kirchhoff sum over vehicles, on a logarithmic axis.
  function junctionFigure({ edges, before, after, load }) {
    const steps = (name, counts, color) => ({ name, x: [edges[0], ...edges], y: [0, ...counts, 0], mode: "lines", fill: "tozeroy",
      line: { shape: "hv", color, width: 1.5 }, hovertemplate: `${name}<br>from %{x:.3g} A: %{y} vehicles<extra></extra>` });
    const data = [steps("as measured", before, BEFORE), steps("after correction", after, AFTER)];
    if (load !== null) data.push({ name: `load without a sensor: ${load.toFixed(1)} A`, x: [load, load], y: [0, Math.max(...before, ...after)],
      mode: "lines", line: { color: OTHER, dash: "dash", width: 1.5 } });
    const layout = { height: 260, xaxis: { type: "log", dtick: "D2", title: { text: "RMS of a vehicle's Kirchhoff sum [A]" } },
      yaxis: { title: { text: "vehicles" }, rangemode: "tozero" } };
    return { data, layout };
  }

  // Gain error and offset of the largest faults, a panel for each branch; for those not corrected also what else they may be.
  function sensorsFigure(columns, details) {
    const markers = { corrected: { color: AFTER }, "not corrected": { color: BEFORE }, [RIVALS]: { color: BEFORE, symbol: "circle-open" } };
    const data = [], rows = Math.ceil(K / MOST_BESIDE), inLegend = new Set(), known = (value) => value || 0;
    const layout = { height: 340 * rows, grid: { rows, columns: Math.ceil(K / rows), pattern: "independent", ygap: 0.25 } };
    facts.branches.forEach((name, k) => {
      const axis = k ? k + 1 : "", points = Object.keys(markers).map((label) => [label, []]), [corrected, open, rivals] = points.map(([, own]) => own);
      const faulty = [...columns.vehicle.keys()].filter((j) => columns.faulty[j * K + k]).sort((a, b) => errorOf(columns, b * K + k) - errorOf(columns, a * K + k));
      for (const j of faulty.slice(0, facts.most_points)) {
        const i = j * K + k, vehicle = columns.vehicle[j];
        (columns.applied[i] ? corrected : open).push({ text: vehicle, x: 100 * known(columns.drift[i]), y: known(columns.offset_a[i]),
          dx: 100 * known(columns.drift_sd[i]), dy: known(columns.offset_sd_a[i]) });
        for (const rival of columns.applied[i] ? [] : (details[j]?.explanations ?? []).slice(1)) if (rival.probability >= LEAST_RIVAL)
          rivals.push({ text: `${vehicle}, ${percent(rival.probability, 0)}`, x: 100 * faultOf(rival, 1, name), y: faultOf(rival, 2, name), dx: 0, dy: 0 });
      }
      const all = points.flatMap(([, own]) => own), range = (values) => [-1.1, 1.1].map((end) => end * values.reduce((most, value) => Math.max(most, Math.abs(value)), 1));
      layout[`xaxis${axis}`] = { title: { text: `${name}: gain error [%]` }, range: range(all.map(({ x }) => x)) };
      layout[`yaxis${axis}`] = { title: { text: k ? "" : "offset [A]" }, range: range(all.map(({ y }) => y)) };
      for (const [label, own] of points.filter(([, own]) => own.length)) {
        const of = (key) => own.map((point) => point[key]), bars = (key) => ({ type: "data", array: of(key), thickness: 0.7, width: 0 });
        data.push({ name: label, legendgroup: label, showlegend: !inLegend.has(label), xaxis: `x${axis}`, yaxis: `y${axis}`, mode: "markers", text: of("text"), x: of("x"), y: of("y"),
          error_x: bars("dx"), error_y: bars("dy"), marker: { size: 7, opacity: 0.7, ...markers[label] }, hovertemplate: "%{text}<br>gain error %{x:.2f} %<br>offset %{y:.2f} A<extra></extra>" });
        inLegend.add(label);
      }
    });
    return { data, layout };
  }

  for (const [event, size] of [["beforeprint", { width: PRINT_WIDTH }], ["afterprint", { width: null, autosize: true }]])
    window.addEventListener(event, () => {
      for (const place of document.querySelectorAll(".plot[data-drawn]")) window.Plotly.relayout(place, size);
    });

  // ---- the table of vehicles -----------------------------------------------------------------------------------
  const sensors = (j) => facts.branches.map((_, k) => j * K + k);
  const errorOf = (columns, i) => Math.abs(columns.drift[i] || 0) * facts.full_scale_a + Math.abs(columns.offset_a[i] || 0); // at full scale [A]
  const named = (columns, j, is) => facts.branches.filter((_, k) => is(j * K + k)).join(", ");
  const correctedOf = (columns, j) => named(columns, j, (i) => columns.applied[i] && columns.faulty[i]);

  function listing(columns) {
    const names = columns.vehicle, N = names.length, largest = new Float64Array(N);
    for (let i = 0; i < N * K; i++) {
      const error = errorOf(columns, i), j = Math.floor(i / K);
      if (columns.faulty[i] && error > largest[j]) largest[j] = error;
    }
    const open = (j) => sensors(j).some((i) => columns.unknown[i]);
    const number = (values) => (a, b) => (Number.isNaN(values[a]) ? 1 : 0) - (Number.isNaN(values[b]) ? 1 : 0) || values[a] - values[b];
    const ranks = once(() => {
      const collator = new Intl.Collator("en", { numeric: true }), place = new Uint32Array(N);
      Array.from(names.keys()).sort((a, b) => collator.compare(names[a], names[b])).forEach((j, rank) => { place[j] = rank; });
      return place;
    });
    const column = (title, values, text, more = {}) => ({ title, text: (j) => text(values[j], j), order: number(values), down: true, ...more });
    return [
      { title: "vehicle", order: (a, b) => ranks()[a] - ranks()[b] },
      column("verdict", columns.verdict, (verdict) => verdict, { style: "text", down: false, order: (a, b) => columns.verdict[a].localeCompare(columns.verdict[b]) }),
      column("confidence", columns.confidence, (p) => probability(p)),
      column("sum before", columns.junction_rms_measured_a, (value) => amperes(value)),
      column("sum after", columns.deployed_a, (value) => amperes(value)),
      column("largest fault", largest, (value, j) => (value ? amperes(value) : open(j) ? UNKNOWN : "none"), { first: true }),
      { title: "corrected", text: (j) => correctedOf(columns, j), style: "wide" },
      column("hardware fault", columns.hardware_probability, (p) => probability(p)),
      column("drives", columns.duration_s, (value) => fixed(value / 60, 1, " min")),
    ];
  }

  function vehicles(columns) {
    const names = columns.vehicle, N = names.length, heads = listing(columns), lower = names.map((name) => name.toLowerCase());
    let shown = [], page = 0, sorted = heads.findIndex((head) => head.first), descending = true;

    for (const kind of new Set(columns.verdict)) $("verdict").append(element("option", { value: kind }, kind));
    // A browser does not print buttons on the later pages of a table, so the same words are there as text, too.
    const headers = heads.map((head, i) => element("th", { scope: "col", class: head.style ?? null }, ...(head.order
      ? [element("button", { type: "button", onclick: () => sortBy(i) }, head.title), element("span", { class: "printed", "aria-hidden": "true" }, head.title)] : [head.title])));
    $("table").tHead.append(element("tr", {}, ...headers));

    function sortBy(i) {
      descending = i === sorted ? !descending : Boolean(heads[i].down);
      sorted = i;
      refresh();
    }

    function refresh() {
      const wanted = $("find").value.trim().toLowerCase(), kind = $("verdict").value;
      const suspected = $("suspected").checked, only = $("only-corrected").checked, { order } = heads[sorted];
      shown = [];
      for (let j = 0; j < N; j++) {
        if ((!wanted || lower[j].includes(wanted)) && (!kind || columns.verdict[j] === kind)
          && (!suspected || columns.hardware_fault[j] === 1) && (!only || columns.corrected[j] === 1)) shown.push(j);
      }
      shown.sort(descending ? (a, b) => order(b, a) || a - b : (a, b) => order(a, b) || a - b);
      headers.forEach((header, i) => i === sorted
        ? header.setAttribute("aria-sort", descending ? "descending" : "ascending") : header.removeAttribute("aria-sort"));
      page = 0;
      turn(0);
    }

    function turn(by) {
      const pages = Math.max(1, Math.ceil(shown.length / ROWS));
      page = Math.min(Math.max(page + by, 0), pages - 1);
      const rows = shown.slice(page * ROWS, (page + 1) * ROWS).map((j) => element("tr", {}, ...heads.map((head, i) =>
        element("td", { class: head.style ?? null },
          i ? head.text(j) : element("button", { type: "button", onclick: () => show(j, columns).catch(fail) }, names[j])))));
      $("table").tBodies[0].replaceChildren(...rows);
      $("count").textContent = `${shown.length.toLocaleString("en")} of ${N.toLocaleString("en")} vehicles`;
      $("page").textContent = `page ${page + 1} of ${pages}`;
      $("previous").disabled = page === 0;
      $("next").disabled = page === pages - 1;
    }

    function save() {
      const quoted = (text) => `"${String(text).replaceAll('"', '""')}"`;
      const plain = (value, digits) => (Number.isNaN(value) ? "" : value.toFixed(digits));
      const per = facts.branches.flatMap((name) => [`${name} drift`, `${name} offset_a`, `${name} applied`]);
      const lines = [["vehicle", "verdict", "confidence", "junction_rms_measured_a", "junction_rms_deployed_a", "hardware_probability", ...per].map(quoted).join(",")];
      for (const j of shown) {
        const own = sensors(j).flatMap((i) => [columns.unknown[i] & 1 ? "" : plain(columns.drift[i], 5), columns.unknown[i] & 2 ? "" : plain(columns.offset_a[i], 2), columns.applied[i]]);
        lines.push([quoted(names[j]), quoted(columns.verdict[j]), plain(columns.confidence[j], 3), plain(columns.junction_rms_measured_a[j], 2),
          plain(columns.deployed_a[j], 2), plain(columns.hardware_probability[j], 3), ...own].join(","));
      }
      const link = element("a", { download: "vehicles.csv", href: URL.createObjectURL(new Blob([`${lines.join("\n")}\n`], { type: "text/csv" })) });
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
    }

    let waiting = 0;
    $("find").addEventListener("input", () => { clearTimeout(waiting); waiting = setTimeout(refresh, 120); });
    for (const id of ["verdict", "suspected", "only-corrected"]) $(id).addEventListener("change", refresh);
    $("previous").addEventListener("click", () => turn(-1));
    $("next").addEventListener("click", () => turn(1));
    $("save").addEventListener("click", save);
    refresh();
    const follow = () => {
      const asked = location.hash.match(/^#vehicle=(.*)$/);
      const j = asked ? names.findIndex((name) => asked[1] === name || asked[1] === encodeURIComponent(name)) : -1;
      if (j >= 0) show(j, columns).catch(fail);
    };
    window.addEventListener("hashchange", follow);
    follow();
  }

  // ---- one vehicle ---------------------------------------------------------------------------------------------
  async function show(j, columns) {
    const place = $("vehicle"), own = (await loadDetails())[j], detailed = own !== undefined, name = columns.vehicle[j];
    const rivals = detailed ? own.explanations : [], findings = detailed ? own.findings : [];
    const evidence = detailed && R > 0 && own.evidence[2][0] !== null ? own.evidence : null;
    const plots = [], plot = (figure) => {
      const at = element("div", { class: "plot" });
      plots.push([at, figure]);
      return at;
    };
    const Title = facts.alone ? "h2" : "h3", title = (text) => element(facts.alone ? "h2" : "h4", {}, text);
    const parts = [];
    if (!facts.alone) parts.push(element(Title, { id: "vehicle-title" }, `Vehicle ${name}`), element("p", {}, sentence(j, columns)));
    parts.push(title("Sensors"), sensorTable(j, columns, rivals, detailed ? own.delays_ms : null), element("p", { class: "soft" },
      "A sensor shows measured = (1 + gain error) · true + offset; the node publishes (measured − offset) / (1 + gain error). ± is one standard deviation, percentages in brackets are probabilities. The files call the gain error drift."));
    if (grows(j, columns)) parts.push(element("p", { class: "notice" }, `The Kirchhoff sum is larger after correction, as another fault, of ${grows(j, columns)}, is not corrected. The corrected currents are nearer to the true ones; the node watches the sum and passes the measured currents through while it is worse.`));
    if (rivals.length) {
      parts.push(title(rivals.length > 1 ? "Competing explanations" : "Explanation"), explanationTable(j, columns, rivals));
      if (rivals.length > 1) parts.push(element("figure", {}, plot(peakFigure(j, columns, rivals)), element("figcaption", {},
        "The larger a circle, the more probable is its explanation. Where a sensor has two circles apart, its value is one or the other, never their mean.")));
    }
    if (!facts.alone && detailed && own.reason && !findings.some(({ text }) => text === own.reason)) parts.push(element("p", { class: "decides" }, `${own.reason}.`));
    parts.push(title("Does the estimate fit the recordings?"), ...fit(findings, evidence, detailed, plot));
    parts.push(element("p", { class: "soft" }, `Its currents as recorded, before and after correction: calibrator kirchhoff LOG --layout LAYOUT --parameters params/${name}.json --plot sum.html`
      + (facts.alone ? "" : `. A page of its own: calibrator report RESULT --vehicle "${name}"`)));
    place.replaceChildren(...parts);
    place.dataset.vehicle = name;
    if (!facts.alone) {
      place.hidden = false;
      place.scrollIntoView({ block: "start" });
      place.focus({ preventScroll: true });
    }
    for (const [at, figure] of plots) await draw(at, figure);
  }

  function sentence(j, columns) {
    const confidence = columns.confidence[j], hardware = columns.hardware_fault[j] === 1;
    return `Verdict: ${columns.verdict[j]}, confidence of the estimate ${probability(confidence)}. `
      + `Kirchhoff sum ${amperes(columns.junction_rms_measured_a[j])} as measured, ${amperes(columns.deployed_a[j])} after correction (RMS over ${fixed(columns.duration_s[j] / 60, 1, " min")}). `
      + (hardware ? `A hardware fault is suspected, probability ${probability(columns.hardware_probability[j])}.` : "");
  }

  const grows = (j, columns) => (columns.deployed_a[j] > columns.junction_rms_measured_a[j]
    ? named(columns, j, (i) => columns.held_back[i]) : "");

  // Gain error (part 1) or offset (part 2) of a sensor in an explanation; 0 if it is not listed there, as it is not faulty.
  const faultOf = (rival, part, name) => (part === 1 ? rival.drift : rival.offset_a)?.[name] ?? 0;

  function sensorTable(j, columns, rivals, delays) {
    const quantity = (i, name, values, sds, part, factor) => {
      const value = values[i], sd = sds[i], unknown = columns.unknown[i] & part, written = (v) => (v ? fixed(factor * v, 2, "", true) : "none");
      // For one junction by itself, the value is the mean over all explanations, and sd their standard deviation.
      const mean = unknown || Number.isNaN(columns.hardware_probability[j]), resolved = RESOLVED * (part === 1 ? 1 : facts.full_scale_a);
      const near = mean ? resolved : Math.max(3 * (sd || 0), resolved), peaks = mean ? [] : [{ value, p: 0 }];
      for (const rival of rivals) {
        const fault = faultOf(rival, part, name), at = peaks.find((peak) => Math.abs(peak.value - fault) <= near);
        if (at) at.p += rival.probability;
        else peaks.push({ value: fault, p: rival.probability });
      }
      const own = sd > 0 ? `${fixed(factor * value, 2, "", true)}\u00a0±\u00a0${(factor * sd).toFixed(2)}` : written(value);
      const several = peaks.filter((peak, n) => (n === 0 && !mean) || peak.p >= LEAST_RIVAL);
      if (several.length < 2) return unknown ? UNKNOWN : own;
      return several.map((peak, n) => `${n === 0 && !mean ? own : written(peak.value)} (${percent(peak.p, 0)})`).join(" or ");
    };
    const node = (i) => columns.applied[i] && columns.faulty[i] ? "corrects it"
      : columns.faulty[i] ? ["does not correct it", columns.held_back[i]].filter(Boolean).join(": ")
      : columns.unknown[i] ? "does not correct it: not known well enough" : "has nothing to correct";
    return table(["branch", "gain error [%]", "offset [A]", "probability of a fault", "risk of harm", "delay", "<the node"],
      facts.branches.map((name, k) => {
        const i = j * K + k;
        return [name, quantity(i, name, columns.drift, columns.drift_sd, 1, 100), quantity(i, name, columns.offset_a, columns.offset_sd_a, 2, 1),
          probability(columns.fault_probability[i]), columns.faulty[i] ? probability(columns.harm_probability[i], 2) : "", delays ? fixed(delays[k] ?? NaN, 0, " ms") : "", node(i)];
      }));
  }

  function explanationTable(j, columns, rivals) {
    const fault = (drift, offset, unknown) => [...(drift ? [percent(drift, 2, true)] : []), ...(offset ? [amperes(offset, true)] : [])].join(", ")
      || (unknown & 1 ? "gain not known" : "no fault");
    const hardware = ({ hardware_drift: drift, hardware_offset_a: offsets }) => [...(drift ? [`all currents ${percent(drift, 2, true)}`] : []),
      ...Object.entries(offsets ?? {}).flatMap(([name, value]) => (value ? [`${name} ${amperes(value, true)}`] : []))].join(", ") || "no fault";
    const total = rivals.reduce((sum, rival) => sum + rival.probability, 0), fleet = !Number.isNaN(columns.hardware_probability[j]);
    const rows = rivals.map((rival) => [percent(rival.probability, 1),
      ...facts.branches.map((name, k) => fault(faultOf(rival, 1, name), faultOf(rival, 2, name), columns.unknown[j * K + k])), ...(fleet ? [hardware(rival)] : [])]);
    if (total < 0.9995) rows.push([percent(1 - total, 1), "all other explanations together"]);
    return table(["probability", ...facts.branches.map((name) => `<${name} sensor`), ...(fleet ? ["<the vehicle itself"] : [])], rows);
  }

  // The posterior predictive check: how far are the measured values from what the estimate predicts?
  function fit(findings, evidence, detailed, plot) {
    const parts = [], misfit = findings.some(({ cause }) => !facts.fleet_causes.includes(cause));
    if (findings.length) {
      parts.push(element("p", {}, misfit ? "No: a gain error and an offset do not explain what the check of fit found." : "This was found beside the faults of the sensors:"),
        table(["<branch", "<cause", "probability", "<what was found"], findings.map(({ branch, cause, probability: p, text }) => [branch ?? "the vehicle", cause, probability(p), text])));
    }
    if (evidence) {
      const [value, sd, explained] = evidence;
      const rows = facts.evidence.map((name, r) => ({ name, z: value[r] === null ? NaN : Math.abs(value[r] - explained[r]) / sd[r] }))
        .filter(({ z }) => !Number.isNaN(z)).sort((a, b) => b.z - a.z);
      const most = rows[0] ?? { name: "", z: 0 }, away = `${most.z.toFixed(1)} standard deviations (${most.name})`;
      parts.push(element("p", {}, most.z <= FITS
        ? `${misfit ? "The gains and constants of the recordings themselves are as the estimate predicts" : "Yes: all that was measured is as the estimate predicts"}, to within ${away}.`
        : `${most.z <= MISFITS ? "Nearly" : "Not all of it"}: what was measured is up to ${away} from what the estimate predicts.`));
      parts.push(element("figure", {}, plot(evidenceFigure(evidence)), element("figcaption", {},
        "What was measured, with standard deviations, and what the estimate predicts. A vehicle without faults is at zero; a load without a sensor moves the junction constant and an intercept.")));
    } else if (!misfit) {
      parts.push(element("p", { class: "soft" }, detailed ? `Not known: ${R ? "the parameters of this vehicle are of an earlier run" : "this calibration keeps no evidence"}.`
        : "The evidence of this vehicle is not part of this page, which would be too large; it stands on the vehicle's own page."));
    }
    return parts;
  }

  function peakFigure(j, columns, rivals) {
    const data = [], layout = { height: panelsHeight(34 * K), showlegend: false };
    [["", 1, 100, "gain error [%]"], ["2", 2, 1, "offset [A]"]].forEach(([axis, part, factor, text], side) => {
      const known = (name, k) => !(columns.unknown[j * K + k] & part) || rivals.some((rival) => faultOf(rival, part, name));
      const points = facts.branches.flatMap((name, k) => rivals.filter(() => known(name, k)).map((rival) => ({ name, x: factor * faultOf(rival, part, name), p: rival.probability })));
      data.push({ type: "scatter", mode: "markers", xaxis: `x${axis}`, yaxis: `y${axis}`, x: points.map(({ x }) => x), y: points.map(({ name }) => name),
        text: points.map(({ p }) => percent(p, 1)), hovertemplate: "%{y}: %{x:.2f}, probability %{text}<extra></extra>",
        marker: { size: points.map(({ p }) => 6 + 26 * Math.sqrt(p)), color: AFTER, opacity: 0.55, line: { color: IDEAL, width: 1 } } });
      layout[`xaxis${axis}`] = { domain: panel(side).x, title: { text }, anchor: `y${axis}` };
      layout[`yaxis${axis}`] = { domain: panel(side).y, type: "category", categoryorder: "array", categoryarray: facts.branches, range: [K - 0.5, -0.5],
        anchor: `x${axis}`, showticklabels: NARROW || !side };  // all branches in both panels, also those without a circle
    });
    return { data, layout };
  }

  function evidenceFigure([value, sd, explained]) {
    const data = [], layout = { height: panelsHeight(26 * Math.max(facts.ratios, R - facts.ratios)) };
    const part = (from, to, axis, scale, shift, text) => {
      const rows = facts.evidence.map((_, r) => r).slice(from, to).filter((r) => value[r] !== null);
      const of = (values, less) => rows.map((r) => scale * (values[r] - less));
      const own = { type: "scatter", mode: "markers", xaxis: `x${axis}`, yaxis: `y${axis}`, y: rows.map((r) => facts.evidence[r]), showlegend: axis === "" };
      data.push({ ...own, name: "measured", legendgroup: "m", x: of(value, shift), marker: { color: BEFORE, size: 7 },
        error_x: { type: "data", array: of(sd, 0), color: BEFORE }, hovertemplate: "%{y}: %{x:.3f}<extra>measured</extra>" });
      data.push({ ...own, name: "predicted by the estimate", legendgroup: "p", x: of(explained, shift), marker: { color: AFTER, size: 11, symbol: "diamond-open" },
        hovertemplate: "%{y}: %{x:.3f}<extra>predicted</extra>" });
      layout[`xaxis${axis}`] = { domain: panel(axis).x, title: { text }, anchor: `y${axis}` };
      layout[`yaxis${axis}`] = { domain: panel(axis).y, autorange: "reversed", anchor: `x${axis}`, side: axis && !NARROW ? "right" : "left" };
    };
    part(0, facts.ratios, "", 100, 1, "gains: deviation from 1 [%]");
    part(facts.ratios, R, "2", 1, 0, "constants [A]");
    return { data, layout };
  }

  // ---- start ---------------------------------------------------------------------------------------------------
  async function start() {
    const columns = await loadColumns();
    if (facts.alone) await show(0, columns);
    else vehicles(columns);
    await loadPlotly();
    document.body.dataset.ready = String(Math.round(performance.now()));
    if (facts.alone) return;
    await draw($("junction-figure"), junctionFigure(facts.junction));
    await draw($("sensors-figure"), sensorsFigure(columns, await loadDetails()));
  }
  start().catch(fail);
})();

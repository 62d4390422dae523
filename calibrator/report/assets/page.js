"use strict";
// The report: unpacks the columns of its vehicles, draws figures when they come into sight, filters, sorts, explains.
(() => {
  const $ = (id) => document.getElementById(id);
  const facts = JSON.parse($("facts").textContent);
  const K = facts.branches.length, N = facts.vehicles, R = facts.evidence.length;
  const MISSING = -2147483648, ROWS = 50, PRINT_WIDTH = 680, UNKNOWN = "not known";
  const LEAST_RIVAL = 0.02, RESOLVED = 0.002, FITS = 3, MISFITS = 4;
  const BEFORE = "#D55E00", AFTER = "#0072B2", IDEAL = "#1b1f24";

  // ---- packed data ---------------------------------------------------------------------------------------------
  async function unpack(id) {
    const text = atob($(`${id}-data`).textContent.trim()), bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
  }

  async function unpackColumns(id, about, steps = null) {
    const bytes = new Uint8Array(await unpack(id)), found = {};
    let start = 0;
    for (const { name, step, length } of about) {
      const values = new Float64Array(length);
      for (let i = 0; i < length; i++) {
        const at = start + i;
        const whole = bytes[at] | (bytes[at + length] << 8) | (bytes[at + 2 * length] << 16) | (bytes[at + 3 * length] << 24);
        values[i] = whole === MISSING ? NaN : whole * step;
      }
      if (steps) for (let i = 0; i < length; i++) values[i] *= steps[i % steps.length];
      found[name] = values;
      start += 4 * length;
    }
    return found;
  }

  const unpackText = async (id) => new TextDecoder().decode(await unpack(id));
  const unpackJson = async (id) => JSON.parse(await unpackText(id));
  const once = (load) => { let found = null; return () => (found ??= load()); };
  const loadPlotly = once(async () => {
    document.head.append(element("script", {}, await unpackText("plotly")));
    return window.Plotly;
  });
  const loadDetails = once(async () => {
    const [texts, evidence] = await Promise.all([unpackJson("details"), unpackColumns("evidence", facts.evidence_columns, facts.evidence_steps)]);
    return { ...texts, ...evidence };
  });

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

  // A heading that begins with < is of a column of text; the last cell of a short row takes the columns that are left.
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

  async function draw(place, { data, layout }) {
    const Plotly = await loadPlotly(), whole = { ...BASE, xaxis: {}, yaxis: {}, ...layout };
    for (const name of Object.keys(whole)) if (/^[xy]axis/.test(name)) whole[name] = { ...AXIS, ...whole[name] };
    await Plotly.newPlot(place, data, whole, { responsive: true, displayModeBar: false });
    place.dataset.drawn = "true";
  }

  function drawWhenSeen() {
    const places = document.querySelectorAll("[data-figure]");
    const drawn = (place) => draw(place, facts.figures[place.dataset.figure]).catch(fail);
    const watch = new IntersectionObserver((entries) => {
      for (const { isIntersecting, target } of entries) {
        if (!isIntersecting) continue;
        watch.unobserve(target);
        drawn(target);
      }
    }, { rootMargin: "400px" });
    for (const place of places) watch.observe(place);
    window.addEventListener("beforeprint", () => {
      for (const place of places) if (!place.dataset.drawn) drawn(place);
      for (const place of document.querySelectorAll(".plot[data-drawn]")) window.Plotly.relayout(place, { width: PRINT_WIDTH });
    });
    window.addEventListener("afterprint", () => {
      for (const place of document.querySelectorAll(".plot[data-drawn]")) window.Plotly.relayout(place, { width: null, autosize: true });
    });
  }

  // ---- the table of vehicles -----------------------------------------------------------------------------------
  const sensors = (j) => facts.branches.map((_, k) => j * K + k);
  const named = (columns, j, is) => facts.branches.filter((_, k) => is(j * K + k)).join(", ");
  const correctedOf = (columns, j) => named(columns, j, (i) => columns.applied[i] && columns.faulty[i]);

  function listing(names, columns) {
    const largest = new Float64Array(N);
    for (let i = 0; i < N * K; i++) {
      const error = Math.abs(columns.drift[i]) * facts.full_scale_a + Math.abs(columns.offset_a[i]), j = Math.floor(i / K);
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
      column("verdict", columns.verdict, (code) => facts.verdicts[code], { style: "text", down: false }),
      column("confidence", columns.confidence, (p) => probability(p)),
      column("sum before", columns.junction_rms_measured_a, (value) => amperes(value)),
      column("sum after", columns.deployed_a, (value) => amperes(value)),
      column("largest fault", largest, (value, j) => (value ? amperes(value) : open(j) ? UNKNOWN : "none"), { first: true }),
      { title: "corrected", text: (j) => correctedOf(columns, j), style: "wide" },
      column("hardware fault", columns.hardware_probability, (p) => probability(p)),
      column("drives", columns.duration_s, (value) => fixed(value / 60, 1, " min")),
    ];
  }

  function vehicles(names, columns) {
    const heads = listing(names, columns), lower = names.map((name) => name.toLowerCase());
    let shown = [], page = 0, sorted = heads.findIndex((head) => head.first), descending = true;

    for (const kind of facts.verdicts) $("verdict").append(element("option", { value: kind }, kind));
    // A browser does not print buttons on the later pages of a table: there the same words stand as text.
    const headers = heads.map((head, i) => element("th", { scope: "col", class: head.style ?? null }, ...(head.order
      ? [element("button", { type: "button", onclick: () => sortBy(i) }, head.title), element("span", { class: "printed", "aria-hidden": "true" }, head.title)] : [head.title])));
    $("table").tHead.append(element("tr", {}, ...headers));

    function sortBy(i) {
      descending = i === sorted ? !descending : Boolean(heads[i].down);
      sorted = i;
      refresh();
    }

    function refresh() {
      const wanted = $("find").value.trim().toLowerCase(), kind = facts.verdicts.indexOf($("verdict").value);
      const suspected = $("suspected").checked, only = $("only-corrected").checked, { order } = heads[sorted];
      shown = [];
      for (let j = 0; j < N; j++) {
        if ((!wanted || lower[j].includes(wanted)) && (kind < 0 || columns.verdict[j] === kind)
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
          i ? head.text(j) : element("button", { type: "button", onclick: () => show(j, names, columns).catch(fail) }, names[j])))));
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
        const own = sensors(j).flatMap((i) => [columns.unknown[i] & 1 ? "" : plain(columns.drift[i], 5), columns.unknown[i] & 2 ? "" : plain(columns.offset_a[i], 3), columns.applied[i]]);
        lines.push([quoted(names[j]), quoted(facts.verdicts[columns.verdict[j]]), plain(columns.confidence[j], 4), plain(columns.junction_rms_measured_a[j], 3),
          plain(columns.deployed_a[j], 3), plain(columns.hardware_probability[j], 4), ...own].join(","));
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
      if (j >= 0) show(j, names, columns).catch(fail);
    };
    window.addEventListener("hashchange", follow);
    follow();
  }

  // ---- one vehicle ---------------------------------------------------------------------------------------------
  async function show(j, names, columns) {
    const place = $("vehicle"), details = await loadDetails(), detailed = j < facts.detailed;
    const rivals = detailed ? details.explanations[j] : [], findings = detailed ? details.findings[j] : [];
    const evidenced = detailed && R > 0 && !Number.isNaN(details.explained[j * R]);
    const plots = [], plot = (figure) => {
      const at = element("div", { class: "plot" });
      plots.push([at, figure]);
      return at;
    };
    const Title = facts.alone ? "h2" : "h3", title = (text) => element(facts.alone ? "h2" : "h4", {}, text);
    const parts = [];
    if (!facts.alone) parts.push(element(Title, { id: "vehicle-title" }, `Vehicle ${names[j]}`), element("p", {}, sentence(j, columns)));
    parts.push(title("Sensors"), sensorTable(j, columns, rivals, detailed ? details.delays_ms[j] : null), element("p", { class: "soft" },
      "A sensor shows measured = (1 + gain error) · true + offset; the node publishes (measured − offset) / (1 + gain error). ± is one standard deviation, percentages in brackets are probabilities. The files call the gain error drift."));
    if (grows(j, columns)) parts.push(element("p", { class: "notice" }, `The Kirchhoff sum is larger after correction, as another fault, of ${grows(j, columns)}, is not corrected. The corrected currents are nearer to the true ones; the node watches the sum and passes the measured currents through while it is worse.`));
    if (rivals.length) {
      parts.push(title(rivals.length > 1 ? "Competing explanations" : "Explanation"), explanationTable(j, columns, rivals));
      if (rivals.length > 1) parts.push(element("figure", {}, plot(peakFigure(j, columns, rivals)), element("figcaption", {},
        "The larger a circle, the more probable is its explanation. Where a sensor has two circles apart, its value is one or the other, never their mean.")));
    }
    if (!facts.alone && detailed && details.reasons[j] && !findings.some(([, , , text]) => text === details.reasons[j])) parts.push(element("p", { class: "decides" }, `${details.reasons[j]}.`));
    parts.push(title("Does the estimate fit the recordings?"), ...fit(j, details, findings, evidenced, detailed, plot));
    if (facts.window && evidenced) {
      parts.push(title("Currents"), element("figure", {}, plot(currentFigure(j, columns, details)), element("figcaption", {},
        `${facts.window.seconds} s of the inputs of vehicle ${facts.window.vehicle}: what this vehicle's sensors show there by its own slopes and intercepts, the same after correction, and the ideal current of the fleet.`)));
    }
    parts.push(element("p", { class: "soft" }, `Its currents as recorded, before and after correction: calibrator kirchhoff LOG --layout LAYOUT --parameters params/${names[j]}.json --plot sum.html`
      + (facts.alone ? "" : `. A page of its own: calibrator report RESULT --vehicle "${names[j]}"`)));
    place.replaceChildren(...parts);
    place.dataset.vehicle = names[j];
    if (!facts.alone) {
      place.hidden = false;
      place.scrollIntoView({ block: "start" });
      place.focus({ preventScroll: true });
    }
    for (const [at, figure] of plots) await draw(at, figure);
  }

  function sentence(j, columns) {
    const confidence = columns.confidence[j], hardware = columns.hardware_fault[j] === 1;
    return `Verdict: ${facts.verdicts[columns.verdict[j]]}, confidence of the estimate ${probability(confidence)}. `
      + `Kirchhoff sum ${amperes(columns.junction_rms_measured_a[j])} as measured, ${amperes(columns.deployed_a[j])} after correction (RMS over ${fixed(columns.duration_s[j] / 60, 1, " min")}). `
      + (hardware ? `A hardware fault is suspected, probability ${probability(columns.hardware_probability[j])}.` : "");
  }

  const grows = (j, columns) => (columns.deployed_a[j] > columns.junction_rms_measured_a[j]
    ? named(columns, j, (i) => !Number.isNaN(columns.held_back[i])) : "");

  function sensorTable(j, columns, rivals, delays) {
    const quantity = (i, k, values, sds, part, factor) => {
      const value = values[i], sd = sds[i], unknown = columns.unknown[i] & part, written = (v) => (v ? fixed(factor * v, 2, "", true) : "none");
      const near = Math.max(3 * (sd || 0), RESOLVED * (part === 1 ? 1 : facts.full_scale_a)), peaks = unknown ? [] : [{ value, p: 0 }];
      for (const rival of rivals) {
        const at = peaks.find((peak) => Math.abs(peak.value - rival[part][k]) <= (unknown ? RESOLVED : near));
        if (at) at.p += rival[0];
        else peaks.push({ value: rival[part][k], p: rival[0] });
      }
      const own = sd > 0 ? `${fixed(factor * value, 2, "", true)} ± ${(factor * sd).toFixed(2)}` : written(value);
      const several = peaks.filter((peak, n) => (n === 0 && !unknown) || peak.p >= LEAST_RIVAL);
      if (several.length < 2) return unknown ? UNKNOWN : own;
      return several.map((peak, n) => `${n === 0 && !unknown ? own : written(peak.value)} (${percent(peak.p, 0)})`).join(" or ");
    };
    const node = (i) => columns.applied[i] && columns.faulty[i] ? "corrects it"
      : columns.faulty[i] ? ["does not correct it", facts.held_back[columns.held_back[i]]].filter(Boolean).join(": ")
      : columns.unknown[i] ? "does not correct it: not known well enough" : "has nothing to correct";
    return table(["branch", "gain error [%]", "offset [A]", "probability of a fault", "risk of harm", "delay", "<the node"],
      facts.branches.map((name, k) => {
        const i = j * K + k;
        return [name, quantity(i, k, columns.drift, columns.drift_sd, 1, 100), quantity(i, k, columns.offset_a, columns.offset_sd_a, 2, 1),
          probability(columns.fault_probability[i]), columns.faulty[i] ? probability(columns.harm_probability[i], 2) : "", delays ? fixed(delays[k] ?? NaN, 0, " ms") : "", node(i)];
      }));
  }

  function explanationTable(j, columns, rivals) {
    const fault = (drift, offset, unknown) => [...(drift ? [percent(drift, 2, true)] : []), ...(offset ? [amperes(offset, true)] : [])].join(", ")
      || (unknown & 1 ? "gain not known" : "no fault");
    const hardware = ([, , , drift, offsets]) => [...(drift ? [`all currents ${percent(drift, 2, true)}`] : []),
      ...facts.branches.flatMap((name, k) => (offsets[k] ? [`${name} ${amperes(offsets[k], true)}`] : []))].join(", ") || "no fault";
    const total = rivals.reduce((sum, rival) => sum + rival[0], 0), fleet = !Number.isNaN(columns.hardware_probability[j]);
    const rows = rivals.map((rival) => [percent(rival[0], 1), ...facts.branches.map((_, k) => fault(rival[1][k], rival[2][k], columns.unknown[j * K + k])), ...(fleet ? [hardware(rival)] : [])]);
    if (total < 0.9995) rows.push([percent(1 - total, 1), "all other explanations together"]);
    return table(["probability", ...facts.branches.map((name) => `<${name} sensor`), ...(fleet ? ["<the vehicle itself"] : [])], rows);
  }

  // The posterior predictive check: how far is what was measured from what the estimate predicts?
  function fit(j, details, findings, evidenced, detailed, plot) {
    const parts = [], misfit = findings.some(([, cause]) => !facts.fleet_causes.includes(cause));
    if (findings.length) {
      parts.push(element("p", {}, misfit ? "No: a gain error and an offset do not explain what the check of fit found." : "This was found beside the faults of the sensors:"),
        table(["<branch", "<cause", "probability", "<what was found"], findings.map(([branch, cause, p, text]) => [branch ?? "the vehicle", cause, probability(p), text])));
    }
    if (evidenced) {
      const rows = facts.evidence.map((name, r) => ({ name, z: Math.abs(details.value[j * R + r] - details.explained[j * R + r]) / details.sd[j * R + r] }))
        .filter(({ z }) => !Number.isNaN(z)).sort((a, b) => b.z - a.z);
      const most = rows[0] ?? { name: "", z: 0 }, away = `${most.z.toFixed(1)} standard deviations (${most.name})`;
      parts.push(element("p", {}, most.z <= FITS
        ? `${misfit ? "The gains and constants of the recordings themselves are as the estimate predicts" : "Yes: all that was measured is as the estimate predicts"}, to within ${away}.`
        : `${most.z <= MISFITS ? "Nearly" : "Not all of it"}: what was measured is up to ${away} from what the estimate predicts.`));
      parts.push(element("figure", {}, plot(evidenceFigure(j, details)), element("figcaption", {},
        "What was measured, with standard deviations, and what the estimate predicts. A vehicle without faults is at zero; a load without a sensor moves the junction constant and an intercept.")));
    } else {
      parts.push(element("p", { class: "soft" }, detailed ? `Not known: ${R ? "the parameters of this vehicle are of an earlier run" : "this calibration keeps no evidence"}.`
        : "The evidence of this vehicle is not part of this page, which would be too large; it stands on the vehicle's own page."));
    }
    return parts;
  }

  function peakFigure(j, columns, rivals) {
    const data = [], layout = { height: 90 + 34 * K, showlegend: false };
    [["", 1, 100, "gain error [%]"], ["2", 2, 1, "offset [A]"]].forEach(([axis, part, factor, text], side) => {
      const known = (k) => !(columns.unknown[j * K + k] & part) || rivals.some((rival) => rival[part][k]);
      const points = facts.branches.flatMap((name, k) => rivals.filter(() => known(k)).map((rival) => ({ name, x: factor * rival[part][k], p: rival[0] })));
      data.push({ type: "scatter", mode: "markers", xaxis: `x${axis}`, yaxis: `y${axis}`, x: points.map(({ x }) => x), y: points.map(({ name }) => name),
        text: points.map(({ p }) => percent(p, 1)), hovertemplate: "%{y}: %{x:.2f}, probability %{text}<extra></extra>",
        marker: { size: points.map(({ p }) => 6 + 26 * Math.sqrt(p)), color: AFTER, opacity: 0.55, line: { color: IDEAL, width: 1 } } });
      layout[`xaxis${axis}`] = { domain: side ? [0.52, 1] : [0, 0.48], title: { text }, anchor: `y${axis}` };
      layout[`yaxis${axis}`] = { autorange: "reversed", type: "category", anchor: `x${axis}`, showticklabels: !side };
    });
    return { data, layout };
  }

  function evidenceFigure(j, { value, sd, explained }) {
    const data = [], layout = { height: 90 + 26 * Math.max(facts.ratios, R - facts.ratios) };
    const part = (from, to, axis, scale, shift, domain, text) => {
      const rows = facts.evidence.map((_, r) => r).slice(from, to).filter((r) => !Number.isNaN(value[j * R + r]));
      const of = (values, less) => rows.map((r) => scale * (values[j * R + r] - less));
      const own = { type: "scatter", mode: "markers", xaxis: `x${axis}`, yaxis: `y${axis}`, y: rows.map((r) => facts.evidence[r]), showlegend: axis === "" };
      data.push({ ...own, name: "measured", legendgroup: "m", x: of(value, shift), marker: { color: BEFORE, size: 7 },
        error_x: { type: "data", array: of(sd, 0), color: BEFORE }, hovertemplate: "%{y}: %{x:.3f}<extra>measured</extra>" });
      data.push({ ...own, name: "predicted by the estimate", legendgroup: "p", x: of(explained, shift), marker: { color: AFTER, size: 11, symbol: "diamond-open" },
        hovertemplate: "%{y}: %{x:.3f}<extra>predicted</extra>" });
      layout[`xaxis${axis}`] = { domain, title: { text }, anchor: `y${axis}` };
      layout[`yaxis${axis}`] = { autorange: "reversed", anchor: `x${axis}`, side: axis ? "right" : "left" };
    };
    part(0, facts.ratios, "", 100, 1, [0, 0.48], "gains: deviation from 1 [%]");
    part(facts.ratios, R, "2", 1, 0, [0.52, 1], "constants [A]");
    return { data, layout };
  }

  function currentFigure(j, columns, details) {
    const { time_s: time, ideal_a: ideal } = facts.window, data = [], layout = { height: 110 * (K + 1) + 90 };
    const row = (name) => {
      const r = j * R + facts.evidence.indexOf(name);
      return Number.isNaN(details.value[r]) ? details.explained[r] : details.value[r];
    };
    const sums = [new Float64Array(time.length), new Float64Array(time.length)];
    const panel = (k, text, lines) => {
      const axis = k ? String(k + 1) : "";
      for (const [name, y, color, dash] of lines) {
        data.push({ type: "scatter", mode: "lines", x: time, y, name, legendgroup: name, showlegend: k === 0, xaxis: "x", yaxis: `y${axis}`,
          line: { color, width: 1.4, dash }, hovertemplate: `${name} %{y:.2f} A<extra></extra>` });
      }
      layout[`yaxis${axis}`] = { title: { text } };
    };
    facts.branches.forEach((name, k) => {
      const slope = row(`slope ${name}`), intercept = row(`intercept ${name}`), i = j * K + k;
      const known = (value, text) => (value === null ? null : text(value));
      const measured = ideal[k].map((value) => known(value, (f) => slope * f + intercept));
      const corrected = columns.applied[i] === 1 ? measured.map((value) => known(value, (m) => (m - columns.offset_a[i]) / (1 + columns.drift[i]))) : measured;
      [measured, corrected].forEach((values, n) => values.forEach((value, t) => { sums[n][t] += value ?? NaN; }));
      panel(k, `${name} [A]`, [["measured", measured, BEFORE], ["corrected", corrected, AFTER], ["ideal", ideal[k], IDEAL, "dot"]]);
    });
    panel(K, "sum [A]", [["measured", Array.from(sums[0]), BEFORE], ["corrected", Array.from(sums[1]), AFTER]]);
    layout.xaxis = { title: { text: "time [s]" }, anchor: `y${K + 1}` };
    layout.grid = { rows: K + 1, columns: 1, subplots: Array.from({ length: K + 1 }, (_, k) => [`xy${k ? k + 1 : ""}`]), roworder: "top to bottom" };
    return { data, layout };
  }

  // ---- start ---------------------------------------------------------------------------------------------------
  async function start() {
    const [names, columns] = await Promise.all([unpackJson("names"), unpackColumns("columns", facts.columns)]);
    if (facts.alone) await show(0, names, columns);
    else vehicles(names, columns);
    drawWhenSeen();
    await loadPlotly();
    document.body.dataset.ready = String(Math.round(performance.now()));
  }
  start().catch(fail);
})();

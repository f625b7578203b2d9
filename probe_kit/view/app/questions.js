// Questions: a row per item, in both layouts: what the VLM answered, what the probes read, where the arm went.
"use strict";
const ROWS = 60, LAYOUTS = ["original", "swapped"], RESPONSES = { 1: ["✓ follows", "right"], 0: ["does not", ""], "-1": ["✗ reverses", "wrong"] };

/* The readings of one episode in the order of the flow; null where nothing is said. */
function readingsOf(run, one, answer) {
  const part = (name) => says(one[name], categoryOf(run, one.category)?.best[name]?.signal);
  const right = (episode) => (episode ? (episode.outcome === "correct" ? "right" : "wrong") : null);
  return { vlm: right(answer), backbone: part("backbone"), action: part("action"), arm: right(one) };
}
/* How often two neighbours in the flow disagree. */
function disagreements(readings) {
  const known = Object.values(readings).filter(Boolean);
  return known.slice(1).filter((value, i) => value !== known[i]).length;
}
function Questions({ run, list, place }) {
  const vlm = run.table.vlm_key, [[, answers], trouble] = useLoaded(vlm && `${vlm}/run`, vlm && `${vlm}/episodes`);
  const rows = useMemo(() => {
    const said = new Map(answers ? listOf(vlm).map((one) => [one.pair, one]) : []), items = new Map();
    const chosen = run.categories.some((c) => c.name === place.category);
    for (const one of list) {
      if (chosen && one.category !== place.category) continue;
      if (!items.has(one.item)) items.set(one.item, { one, layouts: {} });
      items.get(one.item).layouts[one.layout] = { one, readings: readingsOf(run, one, said.get(one.pair)) };
    }
    const score = (row) => Object.values(row.layouts).reduce((sum, own) => sum + disagreements(own.readings), 0);
    return [...items.values()].map((row) => ({ ...row, score: score(row) })).sort((a, b) => b.score - a.score || a.one.number - b.one.number);
  }, [list, answers, place.category]);
  if (trouble) return html`<p class="trouble" role="alert">${trouble}</p>`;
  if (vlm && !answers) return html`<p class="loading">Loading …</p>`;
  const stages = [...(vlm ? [["vlm", "VLM's answer"]] : []), ["backbone", labelOf(run, "backbone")], ["action", labelOf(run, "action")], ["arm", run.answers ? "answer" : "arm"]].filter(([name]) => name === "vlm" || name === "arm" || run.categories.some((c) => c.best[name]));
  const swapped = list.some((one) => one.swap != null);
  const Response = ({ own }) => (own?.one.swap == null ? html`<span class="soft" title="not in the stored image swap">·</span>` : html`<span class=${`mark-cell ${RESPONSES[own.one.swap][1]}`}>${RESPONSES[own.one.swap][0]}</span>`);
  const Mark = ({ own, name }) => {
    if (!own) return html`<span class="soft" title="not played">·</span>`;
    const reading = own.readings[name], odds = name === "backbone" || name === "action" ? signed(own.one[name]) : "";
    return html`<a class=${`mark-cell ${reading ?? ""}`} title=${reading ? `${reading}${odds && `, log-odds ${odds}`}` : "no signal shown"} href=${link({ view: "episodes", ep: own.one.number, t: 0, case: undefined, outcome: undefined, layout: undefined, words: undefined })}>${reading ? `${reading === "right" ? "✓" : "✗"} ${odds}` : "–"}</a>`;
  };
  const names = run.categories.map((c) => c.name), first = ROWS * Math.max(0, Math.min(Math.ceil(rows.length / ROWS) - 1, Math.floor(place.from / ROWS) || 0)), shown = rows.slice(first, first + ROWS);
  const Turn = ({ by, words }) => (rows[first + by] ? html` · <a href=${link({ from: first + by || undefined })}>${words}</a>` : null);
  return html`<div class="questions"><nav class="tabs" aria-label="Categories"><a href=${link({ category: undefined, from: undefined })} aria-current=${names.includes(place.category) ? null : "true"}>all</a>${names.map((name) => html`<a href=${link({ category: name, from: undefined })} aria-current=${name === place.category ? "true" : null}>${titleOf(run, name)}</a>`)}</nav>
    <section class="panel"><h2>Answer, probe, success <small>${rows.length.toLocaleString("en")} items, those with most disagreements first · log-odds at the category's best sites; a dash: no signal shown</small></h2>
    <div class="scroll" tabindex="0" role="region" aria-label="Table by item"><table><thead><tr><th rowspan="2">correct picture</th><th rowspan="2">wrong picture</th><th rowspan="2">category</th>${stages.map(([name, words]) => html`<th colspan="2" key=${name}>${words}</th>`)}${swapped && html`<th colspan="2" title="image swap: the first action goes to the correct picture, and to the other side once the two pictures are swapped">action, pictures swapped</th>`}</tr>
      <tr class="layouts">${[...stages, ...(swapped ? [["swap"]] : [])].flatMap(([name]) => LAYOUTS.map((layout) => html`<th key=${`${name} ${layout}`}>${layout}</th>`))}</tr></thead>
      <tbody>${shown.map((row) => html`<tr key=${row.one.item} data-item=${row.one.item}><th scope="row"><${Text}>${row.one.target ?? row.one.item}<//></th><td><${Text}>${row.one.distractor ?? ""}<//></td><td>${titleOf(run, row.one.category)}</td>
        ${stages.flatMap(([name]) => LAYOUTS.map((layout) => html`<td data-stage=${`${name} ${layout}`}><${Mark} own=${row.layouts[layout]} name=${name} /></td>`))}${swapped && LAYOUTS.map((layout) => html`<td data-stage=${`swap ${layout}`}><${Response} own=${row.layouts[layout]} /></td>`)}</tr>`)}</tbody></table></div>
      ${rows.length > ROWS && html`<p class="note">Items ${(first + 1).toLocaleString("en")} to ${(first + shown.length).toLocaleString("en")} of ${rows.length.toLocaleString("en")}<${Turn} by=${-ROWS} words="previous" /><${Turn} by=${ROWS} words="next" /></p>`}
      ${!vlm && !run.answers && html`<p class="note">Open a VLM run of the same suite too, and its answers stand beside: <code>probe-kit view RUN VLM_RUN</code></p>`}</section></div>`;
}

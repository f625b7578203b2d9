// Results: stored diagnoses, interventions and probes as tables; and the views of runs without sides.
"use strict";
const FOLDED = 40;
/* A stored table. Its first columns name the rows; headings under one group stand together. */
function StoredTable({ table }) {
  const groups = [];
  for (const { group } of table.headings) groups.length && groups[groups.length - 1].group === group ? groups[groups.length - 1].span++ : groups.push({ group, span: 1 });
  const [all, showAll] = useState(false), rows = all ? table.rows : table.rows.slice(0, FOLDED);
  return html`<section class="panel stored" data-kind=${table.kind} data-key=${table.key}><h2><${Text}>${table.title}<//> <small>${table.kind}${table.key && html` · <code>${table.key}</code>`}</small></h2>
    ${table.findings.map((finding) => html`<p class="finding"><${Text}>${finding}<//></p>`)}
    <div class="scroll" tabindex="0" role="region" aria-label=${table.title}><table>
      <thead>${groups.some((g) => g.group) && html`<tr class="layouts">${groups.map((g) => html`<th colspan=${g.span}>${g.group}</th>`)}</tr>`}<tr>${table.headings.map((heading) => html`<th title=${heading.help || null}>${heading.text}</th>`)}</tr></thead>
      <tbody>${rows.map((cells) => html`<tr>${cells.map((cell, i) => { const text = html`<${Text}>${cell.text}<//>`, words = cell.strong ? html`<b>${text}</b>` : text; return i < table.names ? html`<th scope="row">${words}</th>` : html`<td title=${cell.note || null}>${words}</td>`; })}</tr>`)}</tbody></table></div>
    ${table.rows.length > rows.length && html`<p class="note"><button type="button" class="plain" onClick=${() => showAll(true)}>all ${table.rows.length} rows</button></p>`}
    ${(table.curves ?? []).map((chart) => html`<${CutChart} key=${chart.title} chart=${chart} />`)}
    ${table.notes.map((note) => html`<p class="note"><${Text}>${note}<//></p>`)}</section>`;
}
/* What is lost when layers no longer read the tokens of a role: a line a role, and the controls. Open dots: no more than by chance. */
function CutChart({ chart }) {
  const last = Math.max(...chart.layers), [now, setNow] = useState(last), numbers = (values) => values.map((v) => v ?? NaN);
  const lines = chart.lines.map((line, i) => ({ name: line.name, x: chart.layers, y: numbers(line.values), kind: ["expert", "backbone", "done"][i % 3], dots: true, weak: (at) => !line.read[at] }));
  const all = [...lines, { name: "controls", x: chart.layers, y: numbers(chart.controls), kind: "refitted" }], values = all.flatMap((line) => line.y).filter((v) => !Number.isNaN(v));
  const low = Math.min(...values, 0), high = Math.max(...values, 0), room = (high - low || 1) * 0.08;
  return html`<${Series} title=${chart.title} unit=${chart.unit} steps=${last} now=${now} onNow=${setNow} low=${low - room} high=${high + room} lines=${all} />`;
}
function Results({ run }) {
  const [[results], trouble] = useLoaded(`${run.key}/results`);
  if (trouble) return html`<p class="trouble" role="alert">${trouble}</p>`;
  if (!results) return html`<p class="loading">Loading …</p>`;
  const { tables, refused } = results;
  return tables.length || refused.length ? html`<div class="results">${refused.map((reason) => html`<p class="trouble" role="alert"><${Text}>${reason}<//></p>`)}${tables.map((table) => html`<${StoredTable} key=${`${table.kind} ${table.key}`} table=${table} />`)}</div>`
    : html`<p class="empty">Nothing is stored with this run yet. <code>probe-kit diagnose RUN</code> says which inputs matter, <code>probe-kit intervene RUN</code> where they are used, <code>probe-kit train RUN --target TARGET</code> what can be decoded.</p>`;
}

const LONGEST_HEADLINE = 30, LARGE_HEADLINE = 14; // letters: of a headline at all, and of one in large type
/* Overview of a run without sides: what it shows, how its episodes ended, and what is stored with it. */
function SourceOverview({ run, list }) {
  const ends = {};
  for (const one of list) ends[one.outcome] = (ends[one.outcome] ?? 0) + 1;
  const texts = new Set(list.map((one) => one.instruction).filter(Boolean));
  const suite = run.suite.split("#")[0], source = suite.length > LONGEST_HEADLINE ? suite.split("@")[0] : suite; // a revision may be long
  const Head = ({ name, value, words, long }) => html`<div class="head"><span>${name}</span><strong class=${long ? "long" : ""}>${value}</strong><small>${words}</small></div>`;
  return html`<div class="overview"><section class="heads" aria-label="At a glance">
      <${Head} name="source" value=${html`<${Text}>${source}<//>`} words=${run.suite} long=${source.length > LARGE_HEADLINE} />
      <a class="head" href=${link({ view: "episodes" })}><span>episodes</span><strong>${list.length.toLocaleString("en")}</strong><small>${texts.size.toLocaleString("en")} ${texts.size === 1 ? "instruction" : "instructions"}</small></a>
      ${Object.entries(ends).filter(([end]) => end !== "null" && end !== "capture_only").map(([end, count]) => html`<${Head} name=${OUTCOMES[end] ?? end} value=${count.toLocaleString("en")} words=${`of ${list.length.toLocaleString("en")} episodes`} />`)}
      ${run.success && html`<${Head} name="success_once" value=${`${Math.round(100 * run.success.success_once)}%`} words=${run.success.sentence} />`}
      ${run.streams.length > 0 && html`<${Head} name="activations" value=${run.streams.length} words=${run.streams.map((stream) => stream.label).join(", ")} />`}
      ${run.certificate.same_actions != null && html`<${Head} name="certificate" value=${run.certificate.same_actions ? "✓ same actions" : "✗ other actions"} words=${`with and without capture${run.certificate.device ? ` · ${run.certificate.device}` : ""}${run.weights ? ` · weights ${run.weights.slice(0, 12)}` : ""}`} />`}
    </section><${Results} run=${run} /></div>`;
}

/* Layer × iteration of a target: held-out score of every site. The shade is the share of what is above chance. */
function TargetMaps({ run, place }) {
  const index = Math.max(0, run.targets.findIndex((own) => nameOf(run, own) === place.category));
  const [[map], trouble] = useLoaded(run.targets.length > 0 && `${run.key}/target/${index}`), [hover, setHover] = useState(null);
  if (!run.targets.length) return html`<p class="empty">${run.streams.length ? html`No target was probed. <code>probe-kit train RUN --target TARGET</code> fits probes; <code>probe-kit labels RUN</code> lists the built-in targets.` : "This run holds no activations, so that nothing can be probed."}</p>`;
  if (trouble) return html`<p class="trouble" role="alert">${trouble}</p>`;
  if (!map) return html`<p class="loading">Loading …</p>`;
  const own = { ...run, sites: map.sites }, excess = map.score.map((score, i) => (score ?? 0) - (map.chance[i] ?? 0)), best = excess.indexOf(Math.max(...excess));
  const named = map.sites.findIndex((site) => site.name === place.site), site = named >= 0 ? named : best, read = hover ?? site;
  const cell = (i) => ({ t: Math.max(0, excess[i] / (1 - (map.chance[i] ?? 0))), kind: map.signal[i] ? "signal" : "", text: map.sites.length > 80 ? "" : (map.score[i] ?? NaN).toFixed(2), words: `${map.cells[i][0]}${map.signal[i] ? ", signal" : ""}` });
  return html`<div class="maps"><nav class="tabs" aria-label="Targets">${run.targets.map((target, i) => html`<a href=${link({ category: nameOf(run, target), site: undefined })} aria-current=${i === index ? "true" : null}><${Text}>${nameOf(run, target)}<//></a>`)}</nav>
    <section class="panel"><h2><${Text}>${map.target}<//>: held-out ${map.metric} of the probes <small>${map.n} samples, ${map.groups} groups · view ${map.view} · a dot: signal</small></h2>
      <div class="mapwrap"><${SiteMap} run=${own} label=${map.target} chosen=${site} cell=${cell} onChoose=${(i) => go({ site: map.sites[i].name })} onHover=${setHover} legend=${html`<div class="ramp" aria-hidden="true"><span>chance</span><i></i><span>1</span></div>`} />
      <dl class="readout" aria-live="polite" data-read=${map.sites[read].name}><dt>site</dt><dd><b>${nice(own, map.sites[read])}</b></dd>${map.headings.map((heading, k) => html`<dt>${heading}</dt><dd>${map.cells[read][k]}</dd>`)}</dl></div></section></div>`;
}
const nameOf = (run, { target, category }) => (run.targets.filter((own) => own.target === target).length > 1 ? `${target}, ${category}` : target);

/* What the inferences of an episode got and gave, a chart per number; all but actions are folded. */
const KINDS_OF_LINE = ["asked", "done", "arm"];
function Inputs({ episode, now, last, step }) {
  return html`<div class="charts">${episode.inputs.map((group) => {
    const charts = group.series.map((series) => html`<${InputChart} key=${series.name} group=${group} series=${series} episode=${episode} now=${now} last=${last} step=${step} />`);
    return group.title === "actions" ? charts : html`<details><summary>${group.title}: ${group.series.length} ${group.series.length === 1 ? "number" : "numbers"}</summary>${charts}</details>`;
  })}</div>`;
}
function InputChart({ group, series, episode, now, last, step }) {
  const lines = series.lines.map((line, i) => ({ name: line.name, x: episode.inferences, y: [...floats(line.values)], kind: KINDS_OF_LINE[i % 3], hold: true, dots: episode.inferences.length <= 60 }));
  const values = lines.flatMap((line) => line.y).filter((v) => !Number.isNaN(v)), low = Math.min(...values, 0), high = Math.max(...values, 0), room = (high - low || 1) * 0.08;
  return html`<${Series} title=${series.name} unit=${group.title} steps=${last} now=${now} onNow=${step} low=${low - room} high=${high + room} height=${90} digits=${3} lines=${lines} />`;
}

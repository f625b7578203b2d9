// Compare: two runs, episode by episode, where id, scene seed and policy seed are equal.
"use strict";
const APART_CM = 0.5, OTHER_ACTION = 1e-3, FEW = 4;

function Compare({ run, list, runs, place }) {
  const others = runs.filter((r) => r.key !== run.key), other = others.find((r) => r.key === place.with) ?? others[0];
  const [[b, payload], trouble] = useLoaded(other && `${other.key}/run`, other && `${other.key}/episodes`);
  if (!other) return html`<p class="empty">One run is open. Give the command two: <code>probe-kit view A B</code></p>`;
  if (trouble) return html`<p class="trouble" role="alert">${trouble}</p>`;
  if (!b || !payload) return html`<p class="loading">Loading …</p>`;
  const theirs = new Map(listOf(other.key).map((one) => [one.pair, one]));
  const pairs = list.filter((one) => theirs.has(one.pair)).map((one) => ({ a: one, b: theirs.get(one.pair) }));
  const right = (one) => one.outcome === "correct";
  const quads = [[true, true], [true, false], [false, true], [false, false]].map(([p, q]) => ({ p, q, own: pairs.filter((pair) => right(pair.a) === p && right(pair.b) === q) }));
  const pair = pairs.find(({ a }) => a.number === Number(place.ep)) ?? quads[1].own[0] ?? quads[2].own[0] ?? pairs[0];
  const names = [...new Set([...Object.keys(run.settings), ...Object.keys(b.settings)])].filter((name) => run.settings[name] !== b.settings[name]);
  const frames = pairs.filter((p) => p.a.frame && p.a.frame === p.b.frame).length;
  const called = (r) => (run.label === b.label ? `${r.label} (${r.key})` : r.label);
  return html`<div class="compare"><section class="panel"><h2>A <${Text}>${called(run)}<//> and B <${Text}>${called(b)}<//> <small>${pairs.length.toLocaleString("en")} episodes with the same ids and seeds · ${frames.toLocaleString("en")} with the same first frame</small></h2>
    ${others.length > 1 && html`<label class="choice inline"><span>B</span><select value=${other.key} onChange=${(e) => go({ with: e.target.value, ep: undefined })}>${others.map((r) => html`<option value=${r.key}>${r.label} (${r.key})</option>`)}</select></label>`}
    <details open=${names.length <= FEW}><summary>${names.length === 1 ? "1 setting differs" : `${names.length} settings differ`}</summary><table><tbody>${names.map((name) => html`<tr><th scope="row">${name}</th><td><${Text}>${run.settings[name] ?? "–"}<//></td><td><${Text}>${b.settings[name] ?? "–"}<//></td></tr>`)}</tbody></table></details>
    ${pairs.length ? html`<div class="quad">${quads.map(({ p, q, own }) => html`<div class="lane" data-quad=${`${p ? "right" : "wrong"}-${q ? "right" : "wrong"}`}><div class="lanename">A ${p ? "✓" : "✗"} B ${q ? "✓" : "✗"} <b>${own.length}</b></div><div class="chips">${own.slice(0, 80).map(({ a }) => html`<a class="chip" aria-current=${a === pair.a ? "true" : null} title=${a.instruction} href=${link({ ep: a.number, t: 0 })}>${a.number}</a>`)}${own.length > 80 && html`<span class="more">and ${own.length - 80} more</span>`}</div></div>`)}</div>`
      : html`<p class="empty">The runs have no episode with the same id and seeds.</p>`}</section>
    ${pair && html`<${Pair} key=${pair.a.number} run=${run} b=${b} pair=${pair} place=${place} />`}</div>`;
}
/* The site of each run whose log-odds are compared: the chosen one where both have it, else A's best of one stream, or
   the best of each where B has no signal at A's, as another model.
   Null where either has no signal there, since a sign without signal says nothing. */
function comparedSites(runs, maps, place, category) {
  const chosen = runs.map((r) => siteNamed(r, place.site)), best = runs.map((r) => categoryOf(r, category)?.best);
  if (chosen.every((site) => site >= 0)) return chosen.every((site, k) => maps[k]?.signal[site]) ? chosen : null;
  const shared = ["action", "backbone"].map((name) => best[0]?.[name]).filter((own) => own?.signal).map(({ site }) => [site, siteNamed(runs[1], runs[0].sites[site].name)]);
  const same = shared.find(([, theirs]) => maps[1]?.signal[theirs]);
  if (same) return same;
  const part = ["action", "backbone"].find((name) => best.every((own) => own?.[name]?.signal));
  return part ? best.map((own) => own[part].site) : null;
}
/* Of one site in one episode: its log-odds by inference, whether it has signal there, and whether that was tested at this inference. */
function readingAt(run, episode, map, site) {
  const { x, y } = heldValues(episode, logOdds(episode.log_odds), site, run.sites.length);
  return y.map((value, k) => ({ value, step: x[k], signal: signalAt(map, site, k), tested: k === 0 || k in map.refitted }));
}
function Pair({ run, b, pair, place }) {
  const name = (r, one) => `${r.key}/e/${numbered(one.number)}`, mapOf = (r, one) => probed(r).includes(one.category) && `${r.key}/map/${one.category}`;
  const [[x, y, ...maps], trouble] = useLoaded(name(run, pair.a), name(b, pair.b), mapOf(run, pair.a), mapOf(b, pair.b));
  if (trouble) return html`<p class="trouble" role="alert">${trouble}</p>`;
  if (!x || !y || maps.includes(undefined)) return html`<p class="loading">Loading …</p>`;
  const acted = x.trajectory && y.trajectory;
  const title = html`“<${Text}>${pair.a.instruction ?? pair.a.id}<//>”`;
  if (!acted) return html`<section class="panel"><h2>${title}</h2><div class="pair"><div><h3>A <${Outcome} outcome=${pair.a.outcome} /></h3><${Film} run=${run.key} one=${pair.a} frames=${x.frames} now=${pair.a.steps ?? 1} steps=${pair.a.steps ?? 1} /></div><div><h3>B <${Outcome} outcome=${pair.b.outcome} /></h3><${Film} run=${b.key} one=${pair.b} frames=${y.frames} now=${pair.b.steps ?? 1} steps=${pair.b.steps ?? 1} /></div></div></section>`;
  const s = floats(x.trajectory.tool), t = floats(y.trajectory.tool), common = Math.min(x.trajectory.frames, y.trajectory.frames), last = Math.max(x.trajectory.frames, y.trajectory.frames) - 1;
  const apart = Array.from({ length: common }, (_, i) => 100 * Math.hypot(s[3 * i] - t[3 * i], s[3 * i + 1] - t[3 * i + 1], s[3 * i + 2] - t[3 * i + 2]));
  const now = Math.max(0, Math.min(last, Math.floor(Number(place.t)) || 0)), step = (v) => go({ t: v }, true);
  const sites = x.log_odds && y.log_odds ? comparedSites([run, b], maps, place, pair.a.category) : null;
  const readings = sites && [[run, x], [b, y]].map(([r, e], k) => readingAt(r, e, maps[k], sites[k]));
  const found = differences(x, y, apart, readings);
  const names = { [pair.a.side_correct]: pair.a.target, [opposite(pair.a.side_correct)]: pair.a.distractor };
  const odds = (readings ?? []).map((own, k) => ({ name: `${"AB"[k]} ${short([run, b][k].sites[sites[k]].name)}`, x: own.map((r) => r.step), y: own.map((r) => r.value), kind: ["ours", "theirs"][k], hold: true, dots: true, weak: (i) => !own[i].signal }));
  const top = 1.2 * Math.max(4, ...odds.flatMap((line) => line.y.map((v) => Math.abs(v) || 0)));
  const film = (r, one, e, letter) => html`<div><h3>${letter} <${Outcome} outcome=${one.outcome} /></h3><${Film} run=${r.key} one=${one} frames=${e.frames} now=${now} steps=${e.trajectory.frames - 1} /></div>`;
  return html`<section class="panel"><h2>${title} <small class="sentence">${found.length ? `${found.map((f) => f.words).join("; ")}.` : "No difference: the tools never part by 5 mm."}</small></h2>
    <div class="pair">${film(run, pair.a, x, "A")}${film(b, pair.b, y, "B")}
    <div><h3>From above <small>B dashed</small></h3><${Plan} trajectory=${x.trajectory} inferences=${x.inferences} other=${y.trajectory} now=${now} scene=${run.scene} correct=${pair.a.side_correct} names=${names} /></div></div>
    <div class="scrub"><input type="range" min="0" max=${last} value=${now} aria-label="Control step" onInput=${(e) => step(+e.target.value)} /><output>${now} / ${last}</output></div>
    ${!maps.every(Boolean) && html`<p class="note">No log-odds are compared: ${maps.map((map, k) => map ? null : "AB"[k]).filter(Boolean).join(" and ")} ${maps.some(Boolean) ? "has" : "have"} no probes of this category.</p>`}
    ${maps.every(Boolean) && !sites && html`<p class="note">No log-odds are compared: no site that both runs are compared at has signal in both.</p>`}
    ${odds.length > 0 && html`<${Series} title="Probe" unit="log-odds toward the correct side" steps=${last} now=${now} onNow=${step} low=${-top} high=${top} height=${150} lines=${odds} />`}
    <${Series} title="Distance between the tools" unit="cm" steps=${last} now=${now} onNow=${step} low=${0} high=${Math.max(2, ...apart) * 1.1} height=${130} zero=${false} sign=${false} marks=${found.filter((f) => f.kind === "tools").map((f) => ({ name: "5 mm", x: f.step }))} lines=${[{ name: "distance", x: apart.map((_, i) => i), y: apart, kind: "arm" }]} /></section>`;
}
/* What differs first, in the order of the steps: network, commanded action, tools. */
function differences(x, y, apart, readings) {
  const found = [], [p, q] = readings ?? [[], []], sign = (r) => (r?.signal && r.tested && r.value ? Math.sign(r.value) : 0);
  const k = p.findIndex((r, i) => sign(r) * sign(q[i]) < 0);
  if (k >= 0) found.push({ kind: "network", step: p[k].step, words: `the log-odds differ in sign at inference ${k}, step ${p[k].step}` });
  const u = floats(x.trajectory.commanded), v = floats(y.trajectory.commanded), at = u.findIndex((value, i) => i < v.length && Math.abs(value - v[i]) > OTHER_ACTION);
  if (at >= 0) found.push({ kind: "action", step: Math.floor(at / 3) + 1, words: `the commanded actions differ from step ${Math.floor(at / 3) + 1}` });
  const tools = apart.findIndex((far) => far > APART_CM);
  if (tools >= 0) found.push({ kind: "tools", step: tools, words: `the tools part by 5 mm at step ${tools}` });
  return found.sort((f, g) => f.step - g.step);
}

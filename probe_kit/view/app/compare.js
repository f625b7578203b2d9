// Compare: two runs, episode by episode, where id, scene seed and policy seed are equal.
"use strict";
const APART_CM = 0.5, OTHER_ACTION = 1e-3;

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
    <details><summary>${names.length === 1 ? "1 setting differs" : `${names.length} settings differ`}</summary><table><tbody>${names.map((name) => html`<tr><th scope="row">${name}</th><td><${Text}>${run.settings[name] ?? "–"}<//></td><td><${Text}>${b.settings[name] ?? "–"}<//></td></tr>`)}</tbody></table></details>
    ${pairs.length ? html`<div class="quad">${quads.map(({ p, q, own }) => html`<div class="lane" data-quad=${`${p ? "right" : "wrong"}-${q ? "right" : "wrong"}`}><div class="lanename">A ${p ? "✓" : "✗"} B ${q ? "✓" : "✗"} <b>${own.length}</b></div><div class="chips">${own.slice(0, 80).map(({ a }) => html`<a class="chip" aria-current=${a === pair.a ? "true" : null} title=${a.instruction} href=${link({ ep: a.number, t: 0 })}>${a.number}</a>`)}${own.length > 80 && html`<span class="more">and ${own.length - 80} more</span>`}</div></div>`)}</div>`
      : html`<p class="empty">The runs have no episode with the same id and seeds.</p>`}</section>
    ${pair && html`<${Pair} key=${pair.a.number} run=${run} b=${b} pair=${pair} place=${place} />`}</div>`;
}
/* The site whose log-odds are compared: the chosen one where both runs have it, else the best of each stream. */
function comparedSite(run, place, category) {
  const chosen = siteNamed(run, place.site), best = categoryOf(run, category)?.best;
  return chosen >= 0 ? chosen : best?.action?.site ?? best?.backbone?.site;
}
function Pair({ run, b, pair, place }) {
  const name = (r, one) => `${r.key}/e/${numbered(one.number)}`;
  const [[x, y], trouble] = useLoaded(name(run, pair.a), name(b, pair.b));
  if (trouble) return html`<p class="trouble" role="alert">${trouble}</p>`;
  if (!x || !y) return html`<p class="loading">Loading …</p>`;
  const acted = x.trajectory && y.trajectory;
  const title = html`“<${Text}>${pair.a.instruction ?? pair.a.id}<//>”`;
  if (!acted) return html`<section class="panel"><h2>${title}</h2><div class="pair"><div><h3>A <${Outcome} outcome=${pair.a.outcome} /></h3><${Film} run=${run.key} one=${pair.a} frames=${x.frames} now=${1} steps=${1} /></div><div><h3>B <${Outcome} outcome=${pair.b.outcome} /></h3><${Film} run=${b.key} one=${pair.b} frames=${y.frames} now=${1} steps=${1} /></div></div></section>`;
  const s = floats(x.trajectory.tool), t = floats(y.trajectory.tool), common = Math.min(x.trajectory.frames, y.trajectory.frames), last = Math.max(x.trajectory.frames, y.trajectory.frames) - 1;
  const apart = Array.from({ length: common }, (_, i) => 100 * Math.hypot(s[3 * i] - t[3 * i], s[3 * i + 1] - t[3 * i + 1], s[3 * i + 2] - t[3 * i + 2]));
  const now = Math.max(0, Math.min(last, Math.floor(Number(place.t)) || 0)), step = (v) => go({ t: v }, true);
  const found = differences(run, b, pair, x, y, apart, place);
  const names = { [pair.a.side_correct]: pair.a.target, [opposite(pair.a.side_correct)]: pair.a.distractor };
  const odds = [[run, pair.a, x, "A", "backbone"], [b, pair.b, y, "B", "expert"]].flatMap(([r, one, e, letter, kind]) => {
    const site = comparedSite(r, place, one.category);
    if (!e.log_odds || site == null) return [];
    const v = logOdds(e.log_odds), n = r.sites.length, values = Array.from({ length: v.length / n }, (_, k) => v[k * n + site]);
    return [{ name: `${letter} ${short(r.sites[site].name)}`, x: e.inferences.slice(0, values.length), y: values, kind, hold: true, dots: true }];
  });
  const top = 1.2 * Math.max(4, ...odds.flatMap((line) => line.y.map((v) => Math.abs(v) || 0)));
  const film = (r, one, e, letter) => html`<div><h3>${letter} <${Outcome} outcome=${one.outcome} /></h3><${Film} run=${r.key} one=${one} frames=${e.frames} now=${now} steps=${e.trajectory.frames - 1} /></div>`;
  return html`<section class="panel"><h2>${title} <small class="sentence">${found.length ? `${found.map((f) => f.words).join("; ")}.` : "No difference: the tools never part by 5 mm."}</small></h2>
    <div class="pair">${film(run, pair.a, x, "A")}${film(b, pair.b, y, "B")}
    <div><h3>From above <small>B dashed</small></h3><${Plan} trajectory=${x.trajectory} inferences=${x.inferences} other=${y.trajectory} now=${now} scene=${run.scene} correct=${pair.a.side_correct} names=${names} /></div></div>
    <div class="scrub"><input type="range" min="0" max=${last} value=${now} aria-label="Control step" onInput=${(e) => step(+e.target.value)} /><output>${now} / ${last}</output></div>
    ${odds.length > 0 && html`<${Series} title="Probe" unit="log-odds toward the correct side" steps=${last} now=${now} onNow=${step} low=${-top} high=${top} height=${150} lines=${odds} />`}
    <${Series} title="Distance between the tools" unit="cm" steps=${last} now=${now} onNow=${step} low=${0} high=${Math.max(2, ...apart) * 1.1} height=${130} zero=${false} sign=${false} marks=${found.filter((f) => f.kind === "tools").map((f) => ({ name: "5 mm", x: f.step }))} lines=${[{ name: "distance", x: apart.map((_, i) => i), y: apart, kind: "arm" }]} /></section>`;
}
/* What differs first, in the order of the steps: network, commanded action, tools. */
function differences(run, b, pair, x, y, apart, place) {
  const found = [], tools = apart.findIndex((v) => v > APART_CM), u = floats(x.trajectory.commanded), v = floats(y.trajectory.commanded);
  if (tools >= 0) found.push({ kind: "tools", step: tools, words: `the tools part by 5 mm at step ${tools}` });
  const at = u.findIndex((value, i) => i < v.length && Math.abs(value - v[i]) > OTHER_ACTION);
  if (at >= 0) found.push({ kind: "action", step: Math.floor(at / 3) + 1, words: `the commanded actions differ from step ${Math.floor(at / 3) + 1}` });
  const p = comparedSite(run, place, pair.a.category), q = comparedSite(b, place, pair.b.category);
  if (x.log_odds && y.log_odds && p != null && q != null) {
    const s = logOdds(x.log_odds), t = logOdds(y.log_odds), n = run.sites.length, m = b.sites.length;
    for (let k = 0; k < Math.min(s.length / n, t.length / m, x.inferences.length); k++) {
      const one = s[k * n + p], two = t[k * m + q];
      if (!Number.isNaN(one) && !Number.isNaN(two) && one > 0 !== two > 0) { found.push({ kind: "network", step: x.inferences[k], words: `the log-odds differ in sign at inference ${k}, step ${x.inferences[k]}` }); break; }
    }
  }
  return found.sort((f, g) => f.step - g.step);
}

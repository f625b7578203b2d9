// Episodes: the list with its filters, and one episode with its film, plan, map and charts on one time axis.
"use strict";
const FILTERS = ["category", "outcome", "layout", "case", "words"];
const PAIRS = { "right-wrong": "right, arm wrong", "wrong-right": "wrong, arm right", "right-right": "right, arm right", "wrong-wrong": "wrong, arm wrong" };
const COLUMNS = ["item", "category", "layout", "instruction", "target", "distractor", "outcome", "side_correct", "side_placed", "ending"];
const listed = new Map();

/* The episodes of a run, one object each. backbone, action: log-odds of the category's best sites, or NaN. */
function listOf(run) {
  const payload = store.get(`${run}/episodes`);
  if (listed.get(run)?.payload !== payload) {
    const words = Object.fromEntries(COLUMNS.map((name) => [name, spread(payload[name])]));
    const best = Object.fromEntries(["backbone", "action"].map((part) => [part, payload.log_odds[part] && logOdds(payload.log_odds[part])]));
    const list = payload.id.map((id, i) => ({
      id, position: i, number: payload.number[i], steps: payload.steps[i], distance: payload.distance[i], pair: `${id} ${payload.seeds[i]}`, frame: payload.first_frame[i], swap: payload.swap[i],
      ...Object.fromEntries(COLUMNS.map((name) => [name, words[name][i]])), backbone: best.backbone ? best.backbone[i] : NaN, action: best.action ? best.action[i] : NaN,
    }));
    listed.set(run, { payload, list });
  }
  return listed.get(run).list;
}
/* What a probe reads in an episode: a site without signal does not say. */
const says = (value, signal) => (!signal || Number.isNaN(value) || value === 0 ? null : value > 0 ? "right" : "wrong");
const caseOf = (one, value, signal) => { const read = says(value, signal); return read && `${read}-${one.outcome === "correct" ? "right" : "wrong"}`; };
const partCase = (run, one, part) => caseOf(one, one[part], categoryOf(run, one.category)?.best[part]?.signal);
function inCase(run, one, name, chosen) {
  const [part, pair] = name.split(".");
  return (part === "site" ? chosen?.(one).pair : partCase(run, one, part)) === pair;
}
/* The parts whose reading can be crossed with the arm's outcome, and their labels. */
function casesOf(run, place) {
  const parts = ["backbone", "action"].filter((part) => run.categories.some((c) => c.best[part]?.signal));
  return [...parts.map((part) => [part, labelOf(run, part)]), ...(siteNamed(run, place.site) >= 0 ? [["site", short(place.site)]] : [])];
}
/* The episodes that the filters of the address keep; a value that no episode has is no filter. */
function kept(run, list, place, chosen) {
  const words = (place.words ?? "").toLowerCase(), [part, pair] = (place.case ?? "").split("."), known = Object.hasOwn(PAIRS, pair) && casesOf(run, place).some(([name]) => name === part);
  const chosenOf = ["category", "outcome", "layout"].filter((name) => list.some((one) => one[name] === place[name]));
  return list.filter((one) => chosenOf.every((name) => one[name] === place[name])
    && (!known || inCase(run, one, place.case, chosen)) && (!words || `${one.instruction ?? ""} ${one.id} ${one.number}`.toLowerCase().includes(words)));
}

/* ---- filters ---- */
function Choice({ name, label, value, options }) {
  const known = options.some(([v]) => v === value);
  return html`<label class="choice"><span>${label}</span><select name=${name} value=${known ? value : ""} onChange=${(e) => go({ [name]: e.target.value, ep: undefined })}>
    <option value="">all</option>${options.map(([v, words]) => html`<option value=${v}>${words}</option>`)}</select></label>`;
}
function Filters({ run, list, shown, place }) {
  const values = (name, words = (v) => v) => [...new Set(list.map((one) => one[name]))].filter((v) => v != null).sort().map((v) => [v, words(v)]);
  const cases = casesOf(run, place);
  const active = FILTERS.some((name) => place[name]);
  return html`<form class="filters" aria-label="Filters" onSubmit=${(e) => e.preventDefault()}>
    <${Choice} name="category" label="category" value=${place.category} options=${values("category", (v) => titleOf(run, v))} />
    <${Choice} name="outcome" label="outcome" value=${place.outcome} options=${values("outcome", (v) => OUTCOMES[v] ?? v)} />
    ${run.sides && html`<${Choice} name="layout" label="layout" value=${place.layout} options=${values("layout")} />`}
    ${cases.length > 0 && html`<${Choice} name="case" label="probe and arm" value=${place.case} options=${cases.flatMap(([part, words]) => Object.entries(PAIRS).map(([pair, w]) => [`${part}.${pair}`, `${words} ${w}`]))} />`}
    <label class="choice grow"><span>words</span><input name="words" type="search" placeholder="instruction, id, number" value=${place.words ?? ""} onInput=${(e) => go({ words: e.target.value, ep: undefined }, true)} /></label>
    <output class="count" aria-live="polite">${shown.length.toLocaleString("en")} of ${list.length.toLocaleString("en")}</output>
    ${active && html`<button type="button" class="plain" onClick=${() => go(Object.fromEntries(FILTERS.map((name) => [name, undefined])))}>clear</button>`}
  </form>`;
}

/* ---- the list: only the rows in view are in the document ---- */
const ROW = 46;
function EpisodeList({ run, shown, one: chosen, value }) {
  const box = useRef(null), [top, setTop] = useState(0), [tall, setTall] = useState(600);
  useLayoutEffect(() => {
    setTall(box.current.clientHeight);
    const watch = new ResizeObserver(() => setTall(box.current?.clientHeight ?? 600));
    watch.observe(box.current);
    return () => watch.disconnect();
  }, []);
  const at = shown.indexOf(chosen);
  useEffect(() => {
    const y = at * ROW, own = box.current;
    if (at >= 0 && (y < own.scrollTop || y + ROW > own.scrollTop + own.clientHeight)) own.scrollTop = y - own.clientHeight / 2;
  }, [at]);
  const from = Math.max(0, Math.floor(top / ROW) - 6), to = Math.min(shown.length, from + Math.ceil(tall / ROW) + 12);
  return html`<div class="list" ref=${box} onScroll=${(e) => setTop(e.currentTarget.scrollTop)} role="listbox" aria-label="Episodes" tabindex="0"><div style=${{ height: `${shown.length * ROW}px` }}>
    ${shown.slice(from, to).map((one, k) => {
      const { log_odds, signal } = value(one), read = says(log_odds, signal);
      return html`<a key=${one.number} title=${one.instruction} role="option" aria-selected=${one === chosen} aria-setsize=${shown.length} aria-posinset=${from + k + 1} class="item" style=${{ transform: `translateY(${(from + k) * ROW}px)` }} href=${link({ ep: one.number, t: 0 })}>
        <span class=${`sign ${one.outcome}`} aria-label=${OUTCOMES[one.outcome] ?? one.outcome}>${SIGNS[one.outcome] ?? "○"}</span><span class="what"><b><${Text}>${one.instruction ?? one.id}<//></b><small>${one.number} · ${titleOf(run, one.category)}${one.layout ? ` · ${one.layout}` : ` · ${one.item}`}</small></span>
        ${run.sites.length > 0 && html`<span class=${`odds ${read === "right" ? "up" : read === "wrong" ? "down" : ""}`} title=${read ? "" : "no signal shown at this site"}>${signal ? signed(log_odds) : "–"}</span>`}</a>`;
    })}</div></div>`;
}
function Episodes({ run, list, place }) {
  const named = siteNamed(run, place.site), names = probed(run);
  const [maps] = useLoaded(...(named >= 0 ? names.map((name) => `${run.key}/map/${name}`) : []));
  const ready = named >= 0 && maps.length > 0 && maps.every(Boolean);
  const value = useMemo(() => {
    if (!ready) return (one) => { const best = categoryOf(run, one.category)?.best, part = ["action", "backbone"].find((name) => best?.[name]?.signal) ?? "action"; return { log_odds: one[part], signal: best?.[part]?.signal, pair: partCase(run, one, part) }; };
    const at = new Map();
    maps.forEach((map) => { const v = logOdds(map.log_odds); map.rows.forEach((row, i) => at.set(row, [v[named * map.rows.length + i], map.signal[named]])); });
    return (one) => { const [log_odds, signal] = at.get(one.position) ?? [NaN, false]; return { log_odds, signal, pair: caseOf(one, log_odds, signal) }; };
  }, [named, ready, list]);
  const shown = useMemo(() => kept(run, list, place, value), [list, value, ...FILTERS.map((name) => place[name])]);
  const one = shown.find((o) => o.number === Number(place.ep)) ?? shown[0];
  const near = (by) => { const next = shown[shown.indexOf(one) + by]; if (next) go({ ep: next.number, t: 0 }, true); };
  useKeys((e) => {
    if (e.key === "j" || e.key === "ArrowDown") { e.preventDefault(); near(1); }
    if (e.key === "k" || e.key === "ArrowUp") { e.preventDefault(); near(-1); }
    if (e.key === "/") { e.preventDefault(); document.querySelector("input[name=words]").focus(); }
  });
  return html`<div class="episodes"><${Filters} run=${run} list=${list} shown=${shown} place=${place} />
    <div class="split"><aside><p class="listhead">${run.sites.length ? `log-odds at ${named >= 0 ? short(place.site) : "the best site with signal"}` : run.sides ? "this run has no probes" : `${shown.length.toLocaleString("en")} episodes`}</p><${EpisodeList} run=${run} shown=${shown} one=${one} value=${value} /></aside>
    ${one ? html`<${Episode} key=${`${run.key} ${one.number}`} run=${run} one=${one} place=${place} near=${[1, -1].map((by) => shown[shown.indexOf(one) + by]).filter(Boolean)} />`
      : html`<p class="empty">No episode is left. <a href=${link(Object.fromEntries(FILTERS.map((name) => [name, undefined])))}>Clear the filters</a></p>`}</div></div>`;
}

/* ---- one episode ---- */
function frameAt(frames, now, steps) {
  if (frames.steps) return Math.max(0, frames.steps.findLastIndex((step) => step <= now));
  if (frames.all) return Math.min(now, frames.count - 1);
  return frames.count > 1 && now >= steps && steps > 0 ? 1 : 0;
}
/* Attention of the acting stream on the patches of the picture: means over heads and iterations, of one block or of all. */
function attendedAt(attention, now, block) {
  const k = Math.max(0, attention.steps.findLastIndex((step) => step <= now)), all = floats(attention.weights[k]), P = all.length / attention.blocks;
  return Array.from({ length: P }, (_, p) => { const blocks = block === "mean" ? [...Array(attention.blocks).keys()] : [Number(block)], known = blocks.map((b) => all[b * P + p]).filter((v) => !Number.isNaN(v)); return known.length ? known.reduce((a, b) => a + b, 0) / known.length : NaN; });
}
function Attended({ attention, now, block }) {
  const boxes = floats(attention.boxes), values = attendedAt(attention, now, block), most = Math.max(...values.filter((v) => !Number.isNaN(v)), 1e-9), share = values.reduce((sum, v) => sum + (v || 0), 0);
  return html`<svg class="attended" viewBox="0 0 1 1" preserveAspectRatio="none" role="img" aria-label=${`${(100 * share).toFixed(1)} % of the attention lies on this frame`}>
    ${values.map((v, p) => !Number.isNaN(v) && !Number.isNaN(boxes[4 * p]) && html`<rect x=${boxes[4 * p]} y=${boxes[4 * p + 1]} width=${boxes[4 * p + 2] - boxes[4 * p]} height=${boxes[4 * p + 3] - boxes[4 * p + 1]} fill-opacity=${0.8 * (v / most)} />`)}</svg>`;
}
function Film({ run, one, frames, now, steps, bare, attention, block }) {
  if (!frames) return html`<div class="film none">No picture of this episode is stored.${!bare && html` <code>extract --frames all</code> stores every frame.`}</div>`;
  const i = frameAt(frames, now, steps), rows = Math.ceil(frames.count / frames.columns), at = (k, of) => (of > 1 ? `${(100 * k) / (of - 1)}%` : "0%");
  return html`<div class="film" role="img" data-frame=${i} aria-label=${`Camera picture at step ${now}`} style=${{ aspectRatio: `${frames.width} / ${frames.height}`, backgroundImage: `url("data/${run}/f/${numbered(one.number)}.webp")`, backgroundSize: `${100 * frames.columns}% ${100 * rows}%`, backgroundPosition: `${at(i % frames.columns, frames.columns)} ${at(Math.floor(i / frames.columns), rows)}` }}>
    ${attention && block && html`<${Attended} attention=${attention} now=${now} block=${block} />`}
    ${!frames.all && !bare && html`<span class="stamp">${i ? "last" : "first"} frame${frames.count > 1 ? " of two stored" : ""}</span>`}</div>`;
}
const opposite = (side) => (side === "left" ? "right" : "left");
/* (T + 1,) cm of the tool from the middle between the pictures, toward the correct one; and the unit vector. */
function sideways(trajectory, one) {
  const tool = floats(trajectory.tool), [cx, cy] = floats(trajectory.tiles[one.side_correct]), [wx, wy] = floats(trajectory.tiles[opposite(one.side_correct)]);
  const length = Math.hypot(cx - wx, cy - wy) || 1, unit = [(cx - wx) / length, (cy - wy) / length], middle = [(cx + wx) / 2, (cy + wy) / 2];
  const along = (a, i) => 100 * (a[3 * i] * unit[0] + a[3 * i + 1] * unit[1]);
  return { along, tool: Array.from({ length: trajectory.frames }, (_, i) => along(tool, i) - 100 * (middle[0] * unit[0] + middle[1] * unit[1])) };
}
const blockOf = (episode, place) => (episode.attention && (place.attention === "mean" || Number(place.attention) < episode.attention.blocks) && place.attention ? place.attention : "");
function Episode({ run, one, place, near }) {
  const hasMap = probed(run).includes(one.category);
  const [[episode, map], trouble] = useLoaded(`${run.key}/e/${numbered(one.number)}`, hasMap && `${run.key}/map/${one.category}`);
  useEffect(() => { for (const next of near) load(`${run.key}/e/${numbered(next.number)}`).catch(() => {}); }, [one]);
  const [playing, setPlaying] = useState(false);
  const last = episode?.trajectory ? episode.trajectory.frames - 1 : Math.max(one.steps ?? 0, ...(episode?.inferences ?? [])), now = Math.max(0, Math.min(last, Math.floor(Number(place.t)) || 0));
  const step = (t) => go({ t: Math.max(0, Math.min(last, t)) }, true);
  const play = () => { if (now >= last && !playing) step(0); setPlaying(!playing); };
  useEffect(() => {
    if (!playing || !episode) return;
    const timer = setTimeout(() => (now >= last ? setPlaying(false) : step(now + 1)), 200);
    return () => clearTimeout(timer);
  }, [playing, now, last]);
  useKeys((e) => {
    const to = { ArrowRight: now + 1, ArrowLeft: now - 1, Home: 0, End: last }[e.key];
    if (e.key === " " && !e.target.closest("button, a, summary")) { e.preventDefault(); play(); }
    else if (to != null) { e.preventDefault(); step(to); }
  });
  if (trouble) return html`<p class="trouble" role="alert">${trouble}</p>`;
  if (!episode || (hasMap && !map)) return html`<p class="loading">Loading …</p>`;
  const names = { [one.side_correct]: one.target, [opposite(one.side_correct)]: one.distractor };
  return html`<article class="episode" aria-label=${`Episode ${one.number}`}>
    <header><h2>“<${Delivered} text=${one.instruction ?? one.id} lost=${episode.lost_words} />”</h2><${Facts} run=${run} one=${one} episode=${episode} /></header>
    <div class="stage"><div><${Film} run=${run.key} one=${one} frames=${episode.frames} now=${now} steps=${last} attention=${episode.attention} block=${blockOf(episode, place)} />
      ${episode.attention && html`<label class="choice inline"><span>attention</span><select name="attention" value=${blockOf(episode, place)} onChange=${(e) => go({ attention: e.target.value }, true)}><option value="">not shown</option><option value="mean">mean of all blocks</option>${[...Array(episode.attention.blocks).keys()].map((b) => html`<option value=${String(b)}>block ${b}</option>`)}</select></label>
        ${blockOf(episode, place) && html`<p class="note">Attention of the acting stream on the patches of each picture, mean over heads. Descriptive: an attended patch need not be used.</p>`}`}
      ${last > 0 && html`<div class="scrub"><button type="button" onClick=${play} aria-label=${playing ? "Pause" : "Play"}>${playing ? "❚❚" : "▶"}</button>
        <input type="range" min="0" max=${last} value=${now} aria-label="Control step" onInput=${(e) => step(+e.target.value)} /><output>${now} / ${last}</output></div>`}</div>
      ${episode.trajectory && html`<div><${Plan} trajectory=${episode.trajectory} inferences=${episode.inferences} now=${now} scene=${run.scene} correct=${one.side_correct} names=${names} /><p class="note"><span class="mark toolmark"></span>tool <span class="mark cubemark"></span>cube <span class="mark callmark"></span>inference · circle: zone of the rule disc</p></div>`}
      ${map && episode.log_odds && html`<${NetworkNow} run=${run} one=${one} episode=${episode} map=${map} now=${now} place=${place} />`}</div>
    ${episode.trajectory ? html`<${Charts} run=${run} one=${one} episode=${episode} map=${map} now=${now} last=${last} step=${step} place=${place} />`
      : episode.inputs.length ? html`<${Inputs} episode=${episode} now=${now} last=${last} step=${step} />` : html`<p class="empty">${run.answers ? "The model was asked and did not act: nothing moves." : "This run keeps no trajectories: it was made before they were stored, or its model did not act."}</p>`}
    ${Object.keys(episode.words).length > 0 && html`<dl class="readout answers">${Object.entries(episode.words).map(([name, value]) => html`<dt>${name}</dt><dd><${Text}>${value}<//></dd>`)}</dl>`}
  </article>`;
}
/* An instruction; words at its end that did not reach the network are struck out. */
function Delivered({ text, lost }) {
  const words = text.split(/\s+/), kept = words.length - lost;
  return lost ? html`<${Text}>${words.slice(0, kept).join(" ")} <del>${words.slice(kept).join(" ")}</del><//>` : html`<${Text}>${text}<//>`;
}
function Facts({ run, one, episode }) {
  const rules = Object.entries(episode.outcomes);
  return html`<p class="facts"><${Outcome} outcome=${one.outcome} /> ${run.sides && html`<span>correct side: <b>${one.side_correct}</b></span> <span>${run.answers ? "answered" : "placed"}: <b>${one.side_placed ?? "none"}</b></span>`} <span>${titleOf(run, one.category)}</span> ${one.layout && html`<span>${one.layout}</span>`}
    ${one.distance != null && html`<span>${(100 * one.distance).toFixed(1)} cm from the correct picture</span>`}
    ${one.ending && html`<span>ended by ${ENDINGS[one.ending] ?? one.ending}</span>`}
    ${rules.map(([rule, outcome]) => html`<span class="soft" title=${run.rules[rule]}>${rule}: ${OUTCOMES[outcome] ?? outcome}</span>`)}
    ${episode.instruction_tokens > 0 && html`<span class="soft">instruction: ${episode.instruction_tokens} tokens</span>`}
    ${episode.lost_words > 0 && html`<span class="lost">${episode.lost_words} ${episode.lost_words === 1 ? "word" : "words"} did not reach the model: its prompt is cut</span>`}
    <span class="soft">episode ${one.number}</span></p>`;
}
/* The captured inference at a step, and how many there are: log-odds exist of the first K only. */
function inferenceAt(run, episode, now) {
  const calls = logOdds(episode.log_odds).length / run.sites.length;
  let call = 0;
  for (let k = 0; k < calls; k++) if (episode.inferences[k] <= now) call = k;
  return { call, calls };
}
/* Whether a site is shown above chance at an inference: by the probes of that inference where they were fitted. */
function signalAt(map, site, call) {
  const own = call ? map.refitted[call] : map;
  return (own ?? map).signal[site];
}
/* Log-odds of a site over steps: each holds until the next inference, and none is known from the first that was not captured. */
function heldValues(episode, values, site, sites) {
  const y = episode.inferences.map((_, k) => (k < values.length / sites ? values[k * sites + site] : NaN));
  return { x: episode.inferences, y };
}
function NetworkNow({ run, one, episode, map, now, place }) {
  const n = run.sites.length, { call, calls } = inferenceAt(run, episode, now), site = siteOf(run, place, one.category);
  if (!calls) return html`<div class="now"><p class="empty">No inference of this episode was captured.</p></div>`;
  const values = logOdds(place.probe === "refitted" && episode.refitted ? episode.refitted : episode.log_odds);
  const cell = (i) => {
    const v = values[call * n + i], signal = signalAt(map, i, call), side = v > 0 ? "correct" : "wrong";
    if (Number.isNaN(v)) return { t: 0, kind: "blank", words: "no value" };
    return { t: Math.min(1, Math.abs(v) / 6), kind: !signal ? "weak" : v > 0 ? "pro" : "con", words: `${signed(v)} toward the ${side} side${signal ? "" : ", no signal shown"}` };
  };
  return html`<div class="now"><h3>Log-odds at inference ${call} <small>step ${episode.inferences[call]}</small></h3>
    <${SiteMap} run=${run} label="log-odds in this episode" chosen=${site} onChoose=${(i) => go({ site: run.sites[i].name }, true)} cell=${cell}
      legend=${html`<div class="ramp two" aria-hidden="true"><span>wrong</span><i></i><span>correct</span><span><span class="swatch weak"></span> no signal shown</span></div>`} />
    ${episode.refitted && html`<label class="choice inline"><span>probes</span><select name="probe" value=${place.probe === "refitted" ? "refitted" : ""} onChange=${(e) => go({ probe: e.target.value }, true)}><option value="">of inference 0</option><option value="refitted">refitted at each inference</option></select></label>`}
    ${!episode.held_out && html`<p class="note">No fold tests this item: the mean of the folds' log-odds is shown.</p>`}
    ${calls === 1 && episode.inferences.length > 1 && html`<p class="note">One of ${episode.inferences.length} inferences was captured. <code>extract --captured-calls all</code> captures all.</p>`}</div>`;
}
function Charts({ run, one, episode, map, now, last, step, place }) {
  const { trajectory } = episode, n = run.sites.length, { along, tool } = sideways(trajectory, one);
  const frames = Array.from({ length: trajectory.frames }, (_, i) => i), acts = frames.slice(1);
  const commanded = floats(trajectory.commanded), executed = floats(trajectory.executed), opening = floats(trajectory.opening);
  const marks = ["first lateral move", "release"].filter((name) => episode.events[name] != null).map((name) => ({ name, x: episode.events[name] }));
  const reach = Math.max(12, ...tool.map(Math.abs)) * 1.08, best = categoryOf(run, one.category)?.best;
  const chosen = siteNamed(run, place.site);
  const shown = map && episode.log_odds ? [...new Set([best?.backbone?.site, chosen >= 0 ? chosen : best?.action?.site])].filter((i) => i != null) : [];
  const lines = shown.flatMap((site) => {
    const part = run.streams.find((s) => s.name === run.sites[site].stream)?.part === "backbone" ? "backbone" : "expert", name = short(run.sites[site].name);
    const line = (packed, words, kind) => ({ name: words, ...heldValues(episode, logOdds(packed), site, n), kind: `${part} ${kind}`, hold: true, dots: true, weak: (k) => !signalAt(map, site, k) });
    return [line(episode.log_odds, episode.refitted ? `${name}, probe of inference 0` : name, ""), ...(episode.refitted ? [line(episode.refitted, `${name}, refitted`, "refitted")] : [])];
  });
  const top = useMemo(() => {
    if (!shown.length) return 4;
    const v = logOdds(map.log_odds), rows = map.rows.length;
    return 1.2 * Math.max(4, ...shown.map((site) => Math.max(...Array.from(v.subarray(site * rows, (site + 1) * rows), (x) => Math.abs(x) || 0))));
  }, [map, shown.join()]);
  return html`<div class="charts">
    ${lines.length > 0 ? html`<${Series} title="Probe" unit="log-odds toward the correct side" steps=${last} now=${now} onNow=${step} low=${-top} high=${top} height=${170} marks=${marks} above="correct side" below="wrong side" lines=${lines} />`
      : html`<p class="empty">${noProbes(run)}</p>`}
    <${Series} title="Arm" unit="cm toward the correct picture" steps=${last} now=${now} onNow=${step} low=${-reach} high=${reach} height=${140} marks=${marks} lines=${[{ name: "tool", x: frames, y: tool, kind: "arm" }]} />
    <${Series} title="Sideways action" unit="cm per step toward the correct picture" steps=${last} now=${now} onNow=${step} low=${-5} high=${5} height=${110} digits=${2} lines=${[{ name: "commanded", x: acts, y: acts.map((i) => along(commanded, i - 1)), kind: "asked" }, { name: "executed", x: acts, y: acts.map((i) => along(executed, i - 1)), kind: "done" }]} />
    <${Series} title="Gripper" unit="share open" steps=${last} now=${now} onNow=${step} low=${0} high=${1.05} height=${90} zero=${false} sign=${false} digits=${2} lines=${[{ name: "opening", x: frames, y: [...opening], kind: "arm" }]} />
    ${shown.length > 0 && html`<p class="note">A probe of inference 0 meets other activations once the arm has moved: chance there does not mean that the answer is gone. Hollow dots: no signal shown ${episode.refitted || run.captured_calls < 2 ? "at that inference" : html`at inference 0; <code>train --call all</code> tests the later ones`}.</p>`}
  </div>`;
}

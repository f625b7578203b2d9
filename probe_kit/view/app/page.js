// The page: which run and view are shown, light or dark, and the keys.
"use strict";
function toggleTheme() {
  const root = document.documentElement, now = root.dataset.theme || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
  root.dataset.theme = now === "dark" ? "light" : "dark";
  try { localStorage.setItem("probe_kit theme", root.dataset.theme); } catch { /* a browser may refuse to remember */ }
}
try { const chosen = localStorage.getItem("probe_kit theme"); if (chosen) document.documentElement.dataset.theme = chosen; } catch { /* likewise */ }

const VIEW = { overview: Overview, map: Maps, episodes: Episodes, compare: Compare, questions: Questions, results: Results };
/* Views of runs without sides that differ from those of the scene. */
const OTHER_VIEW = { ...VIEW, overview: SourceOverview, map: TargetMaps };
const HELP = [["← →", "step back and forward"], ["space", "play and pause"], ["Home End", "first and last step"], ["j k", "next and previous episode"], ["/", "search"], ["1 2 3 …", "views"], ["?", "these keys"]];
const CLEARED = { ep: undefined, t: undefined, category: undefined, outcome: undefined, layout: undefined, case: undefined, words: undefined, site: undefined, from: undefined };

/* Events of a server tell that a run grew: its payloads are read again, and filter, episode and scroll stay. */
function useGrowth(known) {
  const [grown, set] = useState({});
  useEffect(() => {
    if (!known || !location.protocol.startsWith("http")) return;
    const events = new EventSource("follow");
    events.onmessage = async (event) => {
      const now = JSON.parse(event.data), shown = store.get(`${now.run}/run`);
      if (shown && shown.committed !== now.committed) {
        const maps = [...store.keys()].filter((name) => name.startsWith(`${now.run}/map/`));
        await Promise.all([`${now.run}/run`, `${now.run}/episodes`, ...maps].map((name) => load(name, true))).catch(() => {}); // what was read stays; a view that needs the rest says why
      }
      set((before) => ({ ...before, [now.run]: now }));
    };
    return () => events.close();
  }, [known]);
  return grown;
}
/* What a screen reader is told of a run that grows: one message in ten seconds at most. */
const BETWEEN_MS = 10_000;
function useSpoken(text) {
  const [spoken, set] = useState(""), last = useRef(0);
  useEffect(() => {
    const timer = setTimeout(() => { last.current = Date.now(); set(text); }, Math.max(0, last.current + BETWEEN_MS - Date.now()));
    return () => clearTimeout(timer);
  }, [text]);
  return spoken;
}
function App() {
  const place = usePlace(), [[index], trouble] = useLoaded("index"), help = useRef(null);
  const known = index?.schema === SCHEMA && index.runs.length > 0, key = known ? (index.runs.find((r) => r.key === place.run) ?? index.runs[0]).key : null;
  const grown = useGrowth(known)[key];
  const [[run, episodes], lost] = useLoaded(key && `${key}/run`, key && `${key}/episodes`);
  const failed = grown?.failed ?? run?.failed, live = run && run.committed < run.planned ? `${run.committed} of ${run.planned} episodes so far${failed ? `, ${failed} failed` : ""}` : "", spoken = useSpoken(live);
  useKeys((e) => {
    if (e.key === "?") help.current?.showModal();
    const view = (run?.views ?? [])[Number(e.key) - 1];
    if (view && !help.current?.open) go({ view });
  });
  useEffect(() => { if (run) document.title = `${VIEWS[place.view]} · ${run.label} · probe_kit`; }, [run, place.view]);
  if (index && !known) return html`<p class="trouble" role="alert">The data have schema ${String(index.schema)}; this page reads schema ${SCHEMA}. Export the runs again.</p>`;
  if (trouble || lost) return html`<p class="trouble" role="alert">The data of this page cannot be read: ${trouble ?? lost}</p>`;
  if (!run || !episodes) { const named = index?.runs.find((r) => r.key === key); return html`<p class="loading">Loading ${named ? html`<${Text}>${named.label}<//>, ${named.episodes.toLocaleString("en")} episodes` : "the run"} …</p>`; }
  const list = listOf(run.key), shown = run.views.includes(place.view) ? place.view : "overview", View = (run.sides ? VIEW : OTHER_VIEW)[shown];
  return html`<header class="bar"><a class="brand" href="#/overview">probe_kit</a>
      <label class="run"><span class="sr">Run</span><select value=${run.key} onChange=${(e) => go({ ...CLEARED, run: e.target.value })}>${index.runs.map((r) => html`<option value=${r.key}>${r.label} (${r.key}, ${store.get(`${r.key}/run`)?.committed ?? r.episodes})</option>`)}</select></label>
      ${live && html`<span class="live">${grown && html`<i></i>`}${live}</span>`}<span class="sr" role="status">${spoken}</span>
      ${run.random_weights && html`<span class="random">RANDOM WEIGHTS</span>`}
      <nav aria-label="Views">${run.views.map((view) => [view, VIEWS[view]]).map(([view, words]) => html`<a href=${link({ view })} aria-current=${view === shown ? "page" : null}>${view === "map" ? html`<span class="wide-only">${words}</span><span class="narrow-only">Map</span>` : words}</a>`)}</nav>
      <button type="button" class="plain" onClick=${toggleTheme} aria-label="Light or dark">◐</button><button type="button" class="plain" onClick=${() => help.current.showModal()} aria-label="Keys and words">?</button></header>
    <main id="main">${run.probes_of && html`<p class="remark">This run has no probes of its own. Log-odds are those of the probes of “<${Text}>${run.probes_of}<//>”, and accuracies are of that run.</p>`}${list.length ? html`<${View} key=${`${run.key} ${shown}`} run=${run} runs=${index.runs} list=${list} place=${place} />` : html`<p class="empty">No episode is committed yet.</p>`}</main>
    <dialog ref=${help} onClick=${(e) => e.target === e.currentTarget && e.currentTarget.close()}><h2>Keys</h2><dl class="keys">${HELP.map(([keys, words]) => html`<dt><kbd>${keys}</kbd></dt><dd>${words}</dd>`)}</dl><h2>Words</h2><dl class="words">${(index.words ?? []).map(([word, meaning]) => html`<dt>${word}</dt><dd>${meaning}</dd>`)}</dl><form method="dialog"><button>Close</button></form></dialog>`;
}
render(html`<${App} />`, document.getElementById("app"));

// What is shown stands in the address, and nowhere else. Unknown values fall back and never throw.
"use strict";
const { h, html, render, useState, useEffect, useMemo, useRef, useLayoutEffect } = htmPreact;
const VIEWS = { overview: "Overview", map: "Layer × iteration", episodes: "Episodes", compare: "Compare", questions: "Questions", results: "Results" };

function address() {
  const [path, query] = location.hash.replace(/^#\/?/, "").split("?");
  return { ...Object.fromEntries(new URLSearchParams(query ?? "")), view: Object.hasOwn(VIEWS, path) ? path : "overview" };
}
function link(change) {
  const { view, ...rest } = { ...address(), ...change };
  const query = new URLSearchParams(Object.entries(rest).filter(([, v]) => v != null && v !== "")).toString();
  return `#/${view}${query ? `?${query}` : ""}`;
}
/* Choosing pushes a place, so that Back leads there; scrubbing replaces it. */
function go(change, replace = false) {
  const hash = link(change);
  if (hash === location.hash) return;
  history[replace ? "replaceState" : "pushState"](null, "", hash);
  dispatchEvent(new Event("moved"));
}
function usePlace() {
  const [place, set] = useState(address());
  useEffect(() => {
    const read = () => set(address()), events = ["moved", "hashchange", "popstate"];
    events.forEach((name) => addEventListener(name, read));
    return () => events.forEach((name) => removeEventListener(name, read));
  }, []);
  return place;
}
function useLoaded(...names) {
  const [, set] = useState(0), [trouble, setTrouble] = useState(null), key = names.join("|");
  useEffect(() => {
    let live = true;
    setTrouble(null);
    Promise.all(names.filter(Boolean).map((name) => load(name))).then(() => live && set((n) => n + 1), (e) => live && setTrouble(e.message));
    return () => { live = false; };
  }, [key]);
  return [names.map((name) => (name ? store.get(name) : null)), trouble];
}
function useKeys(press) {
  const latest = useRef(press);
  latest.current = press;
  useEffect(() => {
    const listen = (e) => { if (!e.ctrlKey && !e.metaKey && !e.altKey && !e.target.closest("input, select, textarea, [role=gridcell], [role=application]")) latest.current(e); };
    addEventListener("keydown", listen);
    return () => removeEventListener("keydown", listen);
  }, []);
}

/* ---- words ---- */
const signed = (v, digits = 1) => (v == null || Number.isNaN(v) ? "–" : `${v > 0 ? "+" : v < 0 ? "−" : ""}${Math.abs(v).toFixed(digits)}`);
const Text = ({ children }) => html`<bdi>${children}</bdi>`;
const numbered = (number) => String(number).padStart(5, "0");
const SIGNS = { correct: "✓", wrong: "✗" };
const OUTCOMES = { correct: "correct", wrong: "wrong", oob: "outside", capture_only: "did not act", unread: "no answer read" };
const ENDINGS = { max_steps: "the limit of steps", cube_fell: "the cube's fall", non_finite: "a simulator that broke" };
const Outcome = ({ outcome }) => html`<span class=${`outcome ${SIGNS[outcome] ? outcome : ""}`}><span aria-hidden="true">${SIGNS[outcome] ?? "○"}</span> ${OUTCOMES[outcome] ?? outcome}</span>`;
const short = (site) => site.replace(".residual", "");
function nice(run, site) {
  const stream = run.streams.find((s) => s.name === site.stream);
  return `${stream?.label ?? site.stream} layer ${site.layer}${site.iteration == null ? "" : `, iteration ${site.iteration}`}`;
}
const labelOf = (run, part) => run.streams.find((s) => s.part === part)?.label ?? part;
const categoryOf = (run, name) => run.categories.find((c) => c.name === name);
const titleOf = (run, name) => categoryOf(run, name)?.title ?? name;
const probed = (run) => run.categories.filter((c) => c.best.backbone || c.best.action).map((c) => c.name);
const noProbes = (run) => (run.streams.length ? html`This run has no probes of the correct side. <code>probe-kit train RUN</code> fits them where a category has five independent groups of items.` : "This run holds no activations, so that nothing can be probed.");
const siteNamed = (run, name) => run.sites.findIndex((s) => s.name === name);
/* The site that is shown: the chosen one, or the best of the action or of the backbone, whichever has signal first. */
function siteOf(run, place, category) {
  const chosen = siteNamed(run, place.site), best = categoryOf(run, category)?.best ?? {};
  const named = [best.action, best.backbone].filter(Boolean);
  return chosen >= 0 ? chosen : (named.find((own) => own.signal) ?? named[0])?.site ?? 0;
}

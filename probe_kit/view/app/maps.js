// Layer × iteration: held-out accuracy of every site, and the episodes behind a cell.
"use strict";
const CHIPS = 60;
const shadeOf = (map, chance) => (i) => ({ t: Math.max(0, ((map.accuracy[i] ?? chance) - chance) / (1 - chance)), kind: map.signal[i] ? "signal" : "" });

function Maps({ run, list, place }) {
  const names = probed(run), category = names.includes(place.category) ? place.category : names[0];
  const [all, trouble] = useLoaded(...names.map((name) => `${run.key}/map/${name}`)), [hover, setHover] = useState(null);
  const map = all[names.indexOf(category)], site = names.length ? siteOf(run, place, category) : 0;
  const ranked = useMemo(() => {
    if (!map) return [];
    const v = logOdds(map.log_odds), n = map.rows.length;
    return map.rows.map((row, i) => ({ one: list[row], value: v[site * n + i] })).filter((r) => r.one).sort((a, b) => a.value - b.value);
  }, [map, site, list]);
  const shades = useMemo(() => all.map((own) => own && ((i) => ({ ...shadeOf(own, run.chance)(i), words: own.cells[i][0] }))), all);
  const summary = (own, i) => `${own.signal.filter(Boolean).length} of ${own.signal.length} sites with signal; ${nice(run, run.sites[i])}: ${own.cells[i][0]}`;
  if (!names.length) return html`<p class="empty">${run.answers ? "This model was asked and no stream of it was probed." : noProbes(run)}</p>`;
  if (trouble) return html`<p class="trouble" role="alert">${trouble}</p>`;
  if (!map) return html`<p class="loading">Loading …</p>`;
  const read = hover ?? site, signal = map.signal[site], crowded = run.sites.length > 80;
  const cell = (i) => { const drawn = shadeOf(map, run.chance)(i), text = map.cells[i][0]; return { ...drawn, text: crowded ? "" : Math.round(100 * map.accuracy[i]), words: `${text}${map.signal[i] ? ", signal" : ""}` }; };
  const open = (one) => link({ view: "episodes", category, ep: one.number, case: undefined, outcome: undefined, layout: undefined, words: undefined, site: run.sites[site].name, t: 0 });
  return html`<div class="maps">
    <nav class="tabs" aria-label="Categories">${names.map((name) => html`<a href=${link({ category: name })} aria-current=${name === category ? "true" : null}>${titleOf(run, name)}</a>`)}</nav>
    <section class="panel"><h2>${map.title}: held-out accuracy of the probes <small>${map.n} episodes, ${map.items} items, ${map.groups} groups · view ${map.view} · a dot: signal</small></h2>
      <div class="mapwrap"><${SiteMap} run=${run} label=${map.title} chosen=${site} cell=${cell} onChoose=${(i) => go({ site: run.sites[i].name, category })} onHover=${setHover}
        legend=${html`<div class="ramp" aria-hidden="true"><span>${Math.round(100 * run.chance)} %</span><i></i><span>100 %</span></div>`} />
      <dl class="readout" aria-live="polite" data-read=${run.sites[read].name}><dt>site</dt><dd><b>${nice(run, run.sites[read])}</b></dd>${map.headings.map((heading, k) => html`<dt>${heading}</dt><dd>${map.cells[read][k]}</dd>`)}</dl></div></section>
    <section class="panel"><h2>Episodes at ${nice(run, run.sites[site])} <small>held-out log-odds toward the correct side. A site that was chosen by its accuracy reads too many right: the list is for looking.</small></h2>
      ${signal ? html`<div class="swarm">${Object.entries(PAIRS).map(([pair, words]) => {
        const own = ranked.filter((r) => caseOf(r.one, r.value, true) === pair);
        return html`<div class=${`lane ${pair}`} data-pair=${pair}><div class="lanename">probe ${words} <b>${own.length}</b></div><div class="chips">${own.slice(0, CHIPS).map((r) => html`<a class=${`chip ${r.value > 0 ? "up" : "down"}`} style=${{ "--t": Math.min(1, Math.abs(r.value) / 6) }} href=${open(r.one)} title=${`${r.one.instruction} · ${signed(r.value)}`}>${r.one.number}</a>`)}
          ${own.length > CHIPS && html`<a class="more" href=${link({ view: "episodes", category, case: `site.${pair}`, site: run.sites[site].name, ep: undefined })}>all ${own.length}</a>`}</div></div>`;
      })}</div>` : html`<p class="soft">No signal is shown at this site, so that its sign says neither right nor wrong: ${ranked.length} episodes are not counted.</p>`}</section>
    ${names.length > 1 && html`<section class="panel"><h2>All categories <small>sites in the places of the map above · one scale</small></h2><div class="small-multiples">${names.map((name, k) => all[k] && html`<figure class=${name === category ? "on" : ""}><figcaption><a href=${link({ category: name })}>${titleOf(run, name)}</a></figcaption><${SmallMap} run=${run} label=${`${titleOf(run, name)}, ${summary(all[k], site)}`} chosen=${name === category ? site : null} start=${site} cell=${shades[k]} onChoose=${(i) => go({ category: name, site: run.sites[i].name })} /></figure>`)}</div></section>`}
  </div>`;
}

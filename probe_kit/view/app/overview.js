// Overview: the rows of the table, episodes with the probe right and the arm wrong, and the surest of those episodes.
"use strict";
const WORTH = 6;
function Interval({ cell, chance, kind }) {
  if (cell.value == null) return html`<span class=${cell.text === "–" ? "soft" : ""}>${cell.text}</span>`;
  const x = (v) => 100 * Math.max(0, Math.min(1, v)), [low, high] = cell.limits ?? [null, null];
  return html`<span class="interval"><svg viewBox="0 0 100 12" preserveAspectRatio="none" aria-hidden="true"><rect class="track" x="0" y="5" width="100" height="2" /><rect class="chance" x=${x(chance) - 0.3} y="0" width=".8" height="12" />
    ${low != null && high != null && html`<rect class=${`ci ${kind}`} x=${x(low)} y="3.5" width=${x(high) - x(low)} height="5" />`}<rect class=${`at ${kind}`} x=${Math.min(97.6, Math.max(0, x(cell.value) - 1.2))} y="0" width="2.4" height="12" /></svg><b>${cell.text}</b></span>`;
}
const KINDS = { vlm: "ask", "success.sr": "arm", "backbone.score": "backbone", "action.score": "expert" };
const VIEW_OF = { "backbone.score": "map", "action.score": "map", "success.sr": "episodes" };
/* Episodes of a case by category; null where no site of the category has signal. */
function countCase(run, list, part, pair, category) {
  const own = run.categories.filter((c) => (!category || c.name === category) && c.best[part]?.signal).map((c) => c.name);
  return own.length ? list.filter((one) => own.includes(one.category) && inCase(run, one, `${part}.${pair}`)).length : null;
}
function Overview({ run, list }) {
  const { columns, rows } = run.table, mean = rows.find((row) => row.category === "mean"), single = rows.filter((row) => row !== mean);
  const cellOf = (row, key) => row?.cells[columns.findIndex((c) => c.key === key)];
  const parts = ["backbone", "action"].filter((part) => run.categories.some((c) => c.best[part]));
  const worth = list.filter((one) => inCase(run, one, "backbone.right-wrong")).sort((a, b) => b.backbone - a.backbone).slice(0, WORTH);
  const heading = (key) => columns.find((c) => c.key === key)?.heading;
  const Head = ({ name, kind = "", view }) => { const cell = cellOf(mean, name); return cell ? html`<a class="head" title=${columns.find((c) => c.key === name)?.help} href=${link({ view })}><span>${heading(name)}</span><strong class=${kind}>${cell.text.split(" [")[0]}</strong><small>${cell.text.includes("[") ? `[${cell.text.split(" [")[1]} · ` : ""}mean of ${single.length} ${single.length === 1 ? "category" : "categories"}</small></a>` : null; };
  const total = countCase(run, list, "backbone", "right-wrong");
  return html`<div class="overview">
    <section class="heads" aria-label="At a glance">
      <${Head} name="success.sr" view="episodes" /><${Head} name="backbone.score" kind="backbone" view="map" /><${Head} name="action.score" kind="expert" view="map" />
      ${parts.includes("backbone") && html`<a class="head alert" href=${link({ view: total == null ? "map" : "episodes", case: total == null ? undefined : "backbone.right-wrong", category: undefined, ep: undefined })}><span>backbone right, arm wrong</span><strong>${total ?? "–"}</strong><small>${total == null ? "no site of the backbone has signal" : "episodes, in categories whose best site has signal"}</small></a>`}
      ${run.certificate.same_actions != null && html`<div class="head"><span>certificate</span><strong>${run.certificate.same_actions ? "✓ same actions" : "✗ other actions"}</strong><small>with and without capture${run.certificate.device ? ` · ${run.certificate.device}` : ""}${run.weights ? ` · weights ${run.weights.slice(0, 12)}` : ""}</small></div>`}
    </section>
    ${run.notes.map((note) => html`<p class="remark"><${Text}>${note}<//></p>`)}
    <section class="panel"><h2>By category <small>${list.length.toLocaleString("en")} of ${run.planned.toLocaleString("en")} episodes · 95 % intervals by group · the tick is chance${run.table.vlm ? html` · accuracy: <${Text}>${run.table.vlm}<//>` : ""}</small></h2><div class="scroll" tabindex="0" role="region" aria-label="Table by category"><table>
      <thead><tr><th>category</th>${columns.map((c) => html`<th title=${c.help}>${c.heading}</th>`)}${parts.map((part) => html`<th class="number">${labelOf(run, part)} right, arm wrong</th>`)}</tr></thead>
      <tbody>${single.map((row) => html`<tr><th scope="row"><a href=${link({ view: "episodes", category: row.category, case: undefined, ep: undefined })}>${titleOf(run, row.category)}</a></th>
        ${row.cells.map((cell, i) => { const drawn = html`<${Interval} cell=${cell} chance=${run.chance} kind=${KINDS[columns[i].key]} />`, view = VIEW_OF[columns[i].key]; return html`<td class=${cell.value == null ? "words" : ""}>${view && cell.value != null ? html`<a href=${link({ view, category: row.category, case: undefined, ep: undefined })}>${drawn}</a>` : drawn}</td>`; })}
        ${parts.map((part) => { const count = countCase(run, list, part, "right-wrong", row.category); return html`<td class="number">${count == null ? html`<span class="soft" title="its best site has no signal">–</span>` : html`<a data-count=${`${part} ${row.category}`} href=${link({ view: "episodes", category: row.category, case: `${part}.right-wrong`, ep: undefined })}>${count}</a>`}</td>`; })}</tr>`)}</tbody>
      ${mean && html`<tfoot><tr><th scope="row">mean</th>${mean.cells.map((cell) => html`<td>${cell.text}</td>`)}${parts.map((part) => html`<td class="number">${countCase(run, list, part, "right-wrong") ?? "–"}</td>`)}</tr></tfoot>`}</table></div></section>
    ${worth.length > 0 && html`<section class="panel"><h2>Backbone right, arm wrong <small>${worth.length === total ? "by log-odds" : `the ${worth.length} with the largest log-odds`}</small></h2><div class="worth">${worth.map((one) => html`<${Card} key=${one.number} run=${run.key} one=${one} />`)}</div></section>`}
  </div>`;
}
function Card({ run, one }) {
  const [[episode]] = useLoaded(`${run}/e/${numbered(one.number)}`);
  return html`<a class="card" href=${link({ view: "episodes", ep: one.number, t: 0, category: one.category, case: "backbone.right-wrong" })}>${episode ? html`<${Film} run=${run} one=${one} frames=${episode.frames} now=${one.steps ?? 1} steps=${one.steps ?? 1} bare />` : html`<div class="film none"></div>`}
    <span><${Text}>${one.instruction}<//></span><small><${Outcome} outcome=${one.outcome} /> · backbone ${signed(one.backbone)}</small></a>`;
}

// Marks: every chart is SVG with text, so that it prints, follows the theme, and can be read by tests and screen readers.
"use strict";
function useWidth(least = 240) {
  const ref = useRef(null), [width, set] = useState(640);
  useLayoutEffect(() => {
    const read = () => ref.current && set(Math.max(least, Math.floor(ref.current.clientWidth)));
    read();
    const watch = new ResizeObserver(read);
    watch.observe(ref.current);
    return () => watch.disconnect();
  }, []);
  return [ref, width];
}
function ticks(low, high, about = 5) {
  const raw = (high - low) / about, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw);
  const found = [];
  for (let v = Math.ceil(low / step) * step; v <= high + 1e-9; v += step) found.push(Math.abs(v) < 1e-9 ? 0 : v);
  return found;
}
/* The value of a line at a step: that of the last point at or before it. */
function valueAt(line, now) {
  let found = NaN;
  for (let i = 0; i < line.x.length && line.x[i] <= now; i++) found = line.y[i];
  return found;
}

/* Series over control steps with one shared cursor. lines: {name, x, y, kind, hold, dots, weak}; kind is a class. */
function Series({ title, unit, lines, steps, now, onNow, low, high, height = 150, marks = [], zero = true, above, below, digits = 1, sign = true }) {
  const spelt = (line) => { const v = valueAt(line, now); return sign || Number.isNaN(v) ? signed(v, digits) : v.toFixed(digits); };
  const [ref, width] = useWidth();
  const left = 44, right = width - 10, top = marks.length ? 18 : 8, bottom = 22;
  const X = (v) => left + ((right - left) * v) / Math.max(1, steps);
  const Y = (v) => top + ((height - top - bottom) * (high - Math.max(low, Math.min(high, v)))) / (high - low);
  const path = (line) => {
    let d = "", pen = "M";
    line.y.forEach((v, i) => {
      if (line.hold && pen === "L") d += `H${X(line.x[i]).toFixed(1)}`;
      if (Number.isNaN(v)) { pen = "M"; return; }
      d += `${pen}${X(line.x[i]).toFixed(1)} ${Y(v).toFixed(1)}`;
      pen = "L";
    });
    return line.hold && pen === "L" ? `${d}H${X(steps).toFixed(1)}` : d;
  };
  const at = (event) => {
    const box = ref.current.getBoundingClientRect();
    return Math.max(0, Math.min(steps, Math.round(((event.clientX - box.left - left) / (right - left)) * steps)));
  };
  const drag = (event) => {
    if (!(event.buttons & 1) && event.type !== "pointerdown") return;
    event.currentTarget.setPointerCapture?.(event.pointerId);
    onNow(at(event));
  };
  const named = lines.filter((line) => line.name);
  const words = named.map((line) => `${line.name} ${spelt(line)}`).join(", ");
  return html`<figure class="series" data-series=${title}>
    <figcaption><b>${title}</b> <span class="unit">${unit}</span>
      <span class="keys">${named.map((line) => html`<span class="key"><svg width="22" height="10" aria-hidden="true"><path class=${`line ${line.kind}`} d="M1 5H21"/></svg>${line.name} <output>${spelt(line)}</output></span>`)}</span>
    </figcaption>
    <div ref=${ref}><svg width=${width} height=${height} role="img" aria-label=${`${title}, ${unit}; at step ${now}: ${words}`} onPointerDown=${drag} onPointerMove=${drag}>
      ${above && html`<rect class="half above" x=${left} y=${Y(high)} width=${right - left} height=${Y(0) - Y(high)} /><text class="side" x=${right - 4} y=${Y(high) + 13} text-anchor="end">${above}</text>`}
      ${below && html`<rect class="half below" x=${left} y=${Y(0)} width=${right - left} height=${Y(low) - Y(0)} /><text class="side" x=${right - 4} y=${Y(low) - 5} text-anchor="end">${below}</text>`}
      ${ticks(low, high, height / 28).map((v) => html`<g class="tick"><line x1=${left} x2=${right} y1=${Y(v)} y2=${Y(v)} class=${zero && v === 0 ? "zero" : ""} /><text x=${left - 6} y=${Y(v) + 4} text-anchor="end">${+v.toFixed(3)}</text></g>`)}
      ${ticks(0, Math.max(1, steps), Math.max(3, width / 90)).filter(Number.isInteger).map((v) => html`<text class="tick" x=${X(v)} y=${height - 6} text-anchor="middle">${v}</text>`)}
      ${marks.map((m) => html`<g class="event"><line x1=${X(m.x)} x2=${X(m.x)} y1=${top} y2=${height - bottom} /><text x=${X(m.x)} y=${top - 5} text-anchor=${X(m.x) < 90 ? "start" : X(m.x) > right - 60 ? "end" : "middle"}>${m.name}</text></g>`)}
      ${lines.map((line) => html`<path class=${`line ${line.kind}`} d=${path(line)} />${line.dots && line.x.map((x, i) => !Number.isNaN(line.y[i]) && html`<circle class=${`dot ${line.kind} ${line.weak?.(i) ? "weak" : ""}`} cx=${X(x)} cy=${Y(line.y[i])} r="3.4" />`)}`)}
      <line class="cursor" x1=${X(now)} x2=${X(now)} y1=${top} y2=${height - bottom} />
    </svg></div>
  </figure>`;
}

/* Where sites are drawn: a block per stream, layers upwards, iterations to the right. */
function blocksOf(run) {
  return [...new Set(run.sites.map((s) => s.stream))].map((stream) => {
    const own = run.sites.map((s, i) => ({ ...s, i })).filter((s) => s.stream === stream);
    const layers = [...new Set(own.map((s) => s.layer))].sort((a, b) => a - b);
    const columns = [...new Set(own.map((s) => s.iteration ?? 0))].sort((a, b) => a - b);
    const at = new Map(own.map((s) => [`${s.layer}.${s.iteration ?? 0}`, s.i]));
    return { stream, label: run.streams.find((s) => s.name === stream)?.label ?? stream, layers, columns, at, iterated: own.some((s) => s.iteration != null) };
  });
}
const ARROWS = { ArrowUp: [1, 0], ArrowDown: [-1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
/* The site that an arrow key leads to from site i, on to the next stream at the side of one. */
function beside(run, blocks, i, key) {
  const site = run.sites[i], b = blocks.findIndex((block) => block.stream === site.stream), by = ARROWS[key];
  let block = b, c = blocks[b].columns.indexOf(site.iteration ?? 0) + by[1];
  const r = blocks[b].layers.indexOf(site.layer) + by[0];
  if (c < 0 && b > 0) { block = b - 1; c = blocks[block].columns.length - 1; }
  else if (c >= blocks[b].columns.length && b < blocks.length - 1) { block = b + 1; c = 0; }
  const { layers, columns, at } = blocks[block];
  return at.get(`${layers[Math.max(0, Math.min(r, layers.length - 1))]}.${columns[c]}`) ?? i;
}
/* Layer × iteration. cell(i) gives {t, kind, text, words} of a site. Arrow keys move between cells. */
function SiteMap({ run, cell, chosen, onChoose, onHover, label, legend }) {
  const grid = useRef(null), sites = run.sites, blocks = useMemo(() => blocksOf(run), [sites]);
  const move = (event, i) => {
    if (!ARROWS[event.key]) return;
    event.preventDefault();
    event.stopPropagation();
    grid.current.querySelector(`[data-site="${sites[beside(run, blocks, i, event.key)].name}"]`)?.focus();
  };
  return html`<div class="sitemap" ref=${grid}>${blocks.map((block) => html`<div class="block" style=${{ "--columns": block.columns.length, "--rows": block.layers.length }}>
      <div class="blockname">${block.label} <i>${block.iterated ? "layer ↑ iteration →" : "layer ↑"}</i></div>
      <div class="cells" role="grid" aria-label=${`${label}, ${block.label}: layers upwards${block.iterated ? ", iterations to the right" : ""}`}>
      ${block.layers.map((layer, r) => [layer, r]).reverse().map(([layer, r]) => html`<div role="row" class="row">
        <span class="axis" aria-hidden="true">${block.layers.length <= 8 || layer % 3 === 0 || r === block.layers.length - 1 ? layer : ""}</span>
        ${block.columns.map((column) => {
          const i = block.at.get(`${layer}.${column}`);
          if (i == null) return html`<span class="cell none"></span>`;
          const { t, kind = "", text = "", words } = cell(i);
          return html`<button type="button" role="gridcell" class=${`cell ${kind} ${chosen === i ? "chosen" : ""}`} data-site=${sites[i].name} style=${{ "--t": t }} aria-label=${`${sites[i].name}: ${words}`} title=${`${sites[i].name}: ${words}`}
            tabindex=${chosen === i || (chosen == null && i === 0) ? 0 : -1} onClick=${() => onChoose(i)} onPointerEnter=${() => onHover?.(i)} onFocus=${() => onHover?.(i)} onPointerLeave=${() => onHover?.(null)} onKeyDown=${(e) => move(e, i)}>${text}</button>`;
        })}</div>`)}
      </div>
      <div class="foot" aria-hidden="true"><span class="axis"></span>${block.columns.map((c) => html`<span>${block.iterated ? c : ""}</span>`)}</div>
    </div>`)}
    ${legend}
  </div>`;
}

/* The same in small: a path per tone, so that hundreds of sites are few elements. The tab key stops once; arrows move, Enter chooses. */
const TONES = 20, GAP = 0.6;
function SmallMap({ run, cell, chosen, start, onChoose, label }) {
  const blocks = useMemo(() => blocksOf(run), [run.sites]), [at, setAt] = useState(null);
  const rows = Math.max(...blocks.map((block) => block.layers.length));
  let width = -GAP;
  const starts = blocks.map((block) => { const start = width + GAP; width = start + block.columns.length; return start; });
  const spot = (i) => { const { stream, layer, iteration } = run.sites[i], b = blocks.findIndex((block) => block.stream === stream); return [starts[b] + blocks[b].columns.indexOf(iteration ?? 0), rows - 1 - blocks[b].layers.indexOf(layer)]; };
  const tones = useMemo(() => {
    const found = new Map();
    run.sites.forEach((_, i) => {
      const { t, kind } = cell(i), tone = Math.round(t * TONES), [x, y] = spot(i), own = found.get(tone) ?? { cells: "", dots: "" };
      own.cells += `M${x + 0.04} ${y + 0.06}h.92v.88h-.92z`;
      if (kind === "signal") own.dots += `M${x + 0.64} ${y + 0.16}h.2v.24h-.2z`;
      found.set(tone, own);
    });
    return [...found];
  }, [cell, blocks]);
  const under = (event) => {
    const box = event.currentTarget.getBoundingClientRect(), x = ((event.clientX - box.left) / box.width) * width, y = Math.floor(((event.clientY - box.top) / box.height) * rows);
    const b = starts.findLastIndex((start) => x >= start), block = blocks[b];
    return block?.at.get(`${block.layers[rows - 1 - y]}.${block.columns[Math.floor(x - starts[b])]}`) ?? null;
  };
  const keys = (event) => {
    const here = at ?? start;
    if (ARROWS[event.key]) setAt(beside(run, blocks, here, event.key));
    else if (event.key === "Enter" || event.key === " ") onChoose(here);
    else return;
    event.preventDefault();
    event.stopPropagation();
  };
  const words = at == null ? "" : `${run.sites[at].name}: ${cell(at).words}`;
  const frame = (i, kind) => { const [x, y] = spot(i); return html`<rect class=${kind} x=${x} y=${y} width="1" height="1" />`; };
  return html`<div class="smallmap" role="application" tabindex="0" aria-label=${`${label}; arrows move between sites, Enter chooses one`} title=${words} style=${{ "--rows": rows }}
      onPointerMove=${(e) => setAt(under(e))} onPointerLeave=${() => setAt(null)} onFocus=${() => setAt(start)} onBlur=${() => setAt(null)} onKeyDown=${keys} onClick=${(e) => { const i = under(e); if (i != null) onChoose(i); }}>
    <svg viewBox=${`0 0 ${width} ${rows}`} preserveAspectRatio="none" aria-hidden="true">
      ${tones.map(([tone, { cells, dots }]) => html`<g key=${tone} style=${{ "--t": tone / TONES }}><path class="cells" d=${cells} />${dots && html`<path class="dots" d=${dots} />`}</g>`)}
      ${chosen != null && frame(chosen, "chosen")}${at != null && frame(at, "here")}
    </svg><span class="sr" aria-live="polite">${words}</span></div>`;
}

/* From above, as the camera looks: away from the robot is up, the left tile is left. Tiles are drawn where they are now. */
function Plan({ trajectory, inferences, now, scene, correct, names, other }) {
  const tool = floats(trajectory.tool), cube = floats(trajectory.cube), n = trajectory.frames, theirs = other && floats(other.tool);
  const tiles = Object.fromEntries(["left", "right"].map((side) => { const a = floats(trajectory.tiles[side]), i = Math.min(now, a.length / 2 - 1); return [side, [a[2 * i], a[2 * i + 1]]]; }));
  const half = scene.tile_side / 2, reach = Math.max(half, scene.epsilon) + 0.02;
  const { x0, x1, y0, y1 } = useMemo(() => {
    const xs = [scene.home[0]], ys = [scene.home[1]];
    for (const side of ["tile_left", "tile_right"]) { xs.push(scene[side][0] + reach, scene[side][0] - reach); ys.push(scene[side][1] + reach, scene[side][1] - reach); }
    for (const a of [tool, cube, theirs].filter(Boolean)) for (let i = 0; i < a.length; i += 3) { xs.push(a[i]); ys.push(a[i + 1]); }
    const within = (v, low, high) => Math.max(low, Math.min(high, v));
    return { x0: within(Math.min(...xs), -0.5, 1.5) - 0.02, x1: within(Math.max(...xs), -0.5, 1.5) + 0.06, y0: within(Math.min(...ys), -1, 1), y1: within(Math.max(...ys), -1, 1) };
  }, [trajectory, other]);
  const size = 1000, S = size / (y1 - y0), X = (y) => (y1 - y) * S, Y = (x) => (x1 - x) * S;
  const path = (a, to) => { let d = ""; for (let i = 0; i <= to; i++) d += `${i ? "L" : "M"}${X(a[3 * i + 1]).toFixed(1)} ${Y(a[3 * i]).toFixed(1)}`; return d; };
  const spot = (a, i, r, kind) => html`<circle class=${kind} cx=${X(a[3 * i + 1])} cy=${Y(a[3 * i])} r=${r} />`;
  const t = Math.min(now, n - 1);
  return html`<svg class="plan" viewBox=${`0 0 ${size} ${Y(x0)}`} role="img" aria-label=${`From above at step ${t}: tool ${signed(100 * tool[3 * t + 1], 0)} cm to the left of the middle, ${(100 * tool[3 * t + 2]).toFixed(0)} cm high`}>
    ${["left", "right"].map((side) => { const [x, y] = tiles[side]; return html`<g class=${`tile ${side === correct ? "right" : "wrong"}`}>
      <circle class="zone" cx=${X(y)} cy=${Y(x)} r=${scene.epsilon * S} /><rect x=${X(y) - half * S} y=${Y(x) - half * S} width=${2 * half * S} height=${2 * half * S} rx="6" />
      <text x=${X(y)} y=${Y(x) - half * S - 40} text-anchor="middle" class="what">${names[side]}</text><text x=${X(y)} y=${Y(x) - half * S - 10} text-anchor="middle" class="which">${side === correct ? `✓ ${side}` : side}</text></g>`; })}
    ${theirs && html`<path class="path theirs" d=${path(theirs, theirs.length / 3 - 1)} />`}
    <path class="path cube" d=${path(cube, t)} />
    <path class="path rest" d=${path(tool, n - 1)} /><path class="path tool" d=${path(tool, t)} />
    ${inferences.map((step) => step < n && spot(tool, step, 8, step <= t ? "call past" : "call"))}
    ${spot(cube, t, 13, "cubenow")}${spot(tool, t, 16, "toolnow")}
  </svg>`;
}

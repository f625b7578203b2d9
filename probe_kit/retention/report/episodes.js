"use strict";
(() => {
  // -- episodes: a page of cards at a time, made when they are wanted --------------------------------------------
  const PAGE = 48;
  const OUTCOMES = { correct: "✓ correct", wrong: "✗ wrong picture", oob: "○ on neither", capture_only: "captured only" };
  const ANSWERS = { correct: "✓ right answer", wrong: "✗ wrong answer", oob: "○ no answer read" };
  const EITHER = { correct: "✓ correct", wrong: "✗ wrong", oob: "○ neither", capture_only: "captured only" };
  const source = document.getElementById("cards");
  const every = JSON.parse(source.textContent);
  const cards = [...every.filter((card) => card.picture !== null), ...every.filter((card) => card.picture === null)];
  const outcomes = cards.every((card) => card.asked) ? ANSWERS : cards.some((card) => card.asked) ? EITHER : OUTCOMES;
  const block = Number(source.dataset.block);
  const blocks = document.querySelectorAll("script.pictures");
  const parsed = new Map();
  const form = document.getElementById("filters");
  const grid = document.getElementById("grid");
  const more = document.getElementById("more");
  let matching = [];

  function element(name, properties, ...children) {
    const made = Object.assign(document.createElement(name), properties);
    made.append(...children);
    return made;
  }

  function picture(place) {
    const at = Math.floor(place / block);
    if (!parsed.has(at)) parsed.set(at, JSON.parse(blocks[at].textContent));
    return parsed.get(at)[place % block];
  }

  function draw(card) {
    const shown = card.picture !== null;
    const still = card.frames === 1;
    const frames = element("div", { className: ["frames", still ? "one" : "", card.half ? "half" : ""].join(" ").trim() });
    if (shown) {
      const alt = `${still ? "first frame" : "first and last frame"}: ${card.instruction}`;
      frames.append(
        element("img", { alt, src: `data:image/webp;base64,${picture(card.picture)}`, loading: "lazy", decoding: "async" }),
        ...(still ? [] : [element("i", { textContent: "first" }), element("i", { textContent: "last" })]));
    }
    const outcome = (card.asked ? ANSWERS : OUTCOMES)[card.outcome] + (card.unmoved ? ", cube never moved" : "");
    const answer = card.answer ? `answer: ${card.answer}, ${card.side}` : `answer: ${card.side}`;
    const where = [card.category.replaceAll("_", " "), card.layout].join(" · ");
    const text = element("div", { className: "text" },
      element("b", { textContent: card.instruction || card.id }),
      element("span", { className: "outcome", textContent: outcome }),
      element("br", {}),
      element("small", { textContent: `${answer} · ${where}`, title: `${card.run} ${card.id}` }));
    const made = element("article", { className: `card ${card.outcome}${shown && still ? " still" : ""}` }, ...(shown ? [frames] : []), text);
    made.dataset.id = card.id;
    return made;
  }

  function showMore() {
    const shown = grid.childElementCount;
    grid.append(...matching.slice(shown, shown + PAGE).map(draw));
    more.hidden = grid.childElementCount === matching.length;
    document.getElementById("count").textContent =
      `${grid.childElementCount} shown, ${matching.length} match, ${cards.length} in all`;
  }

  function filter() {
    const words = form.elements.words.value.trim().toLowerCase();
    const wanted = [...form.querySelectorAll("select")].filter((select) => select.value);
    matching = cards.filter((card) =>
      wanted.every((select) => card[select.name] === select.value) &&
      (!words || card.instruction.toLowerCase().includes(words)));
    grid.replaceChildren();
    showMore();
  }

  for (const select of form.querySelectorAll("select")) {
    for (const value of new Set(cards.map((card) => card[select.name]))) {
      const label = select.name === "outcome" ? outcomes[value] : value.replaceAll("_", " ");
      select.append(element("option", { value, textContent: label }));
    }
  }
  form.addEventListener("input", filter);
  form.addEventListener("submit", (event) => event.preventDefault());
  more.addEventListener("click", showMore);
  filter();
})();

"use strict";
(() => {
  // -- tables: a click on a heading sorts, a second one turns the order round, a third one puts it back; empty
  // cells stay last, and differences below the runs ---------------------------------------------------------------
  const number = (text) => (text === "" || Number.isNaN(Number(text)) ? null : Number(text));

  function compare(a, b, sign) {
    if (a === undefined || b === undefined) return (a === undefined) - (b === undefined);
    const [x, y] = [number(a), number(b)];
    if (x !== null && y !== null) return sign * (x - y);
    return sign * a.localeCompare(b, undefined, { numeric: true });
  }

  const NEXT = { none: "ascending", ascending: "descending", descending: "none" };
  const original = new Map();

  function sort(table, column) {
    const heading = table.tHead.rows[0].cells[column];
    const body = table.tBodies[0];
    if (!original.has(table)) original.set(table, [...body.rows]);
    const order = NEXT[heading.getAttribute("aria-sort") ?? "none"];
    for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
    if (order === "none") return body.append(...original.get(table));
    heading.setAttribute("aria-sort", order);
    const key = (row) => row.cells[column].dataset.sort;
    const apart = (row) => Number(row.classList.contains("difference"));
    const sign = order === "ascending" ? 1 : -1;
    body.append(...[...body.rows].sort((a, b) => apart(a) - apart(b) || compare(key(a), key(b), sign)));
  }

  for (const table of document.querySelectorAll("table.sortable")) {
    [...table.tHead.rows[0].cells].forEach((cell, column) =>
      cell.querySelector("button")?.addEventListener("click", () => sort(table, column)));
  }

  // -- wide tables say that there is more to the side --------------------------------------------------------------
  function cue(scroll) {
    const rest = scroll.scrollWidth - scroll.clientWidth;
    const box = scroll.parentElement;
    box.classList.toggle("wide", rest > 1);
    box.classList.toggle("more-left", scroll.scrollLeft > 1);
    box.classList.toggle("more-right", scroll.scrollLeft < rest - 1);
  }

  for (const scroll of document.querySelectorAll(".scroll")) {
    scroll.addEventListener("scroll", () => cue(scroll), { passive: true });
    new ResizeObserver(() => cue(scroll)).observe(scroll);
    cue(scroll);
  }

  // -- folded sections open for links that lead into them, for the button and for print; afterwards they are as before
  function reveal() {
    const target = location.hash && document.getElementById(decodeURIComponent(location.hash.slice(1)));
    if (!target) return;
    for (let one = target; one; one = one.parentElement) if (one.tagName === "DETAILS") one.open = true;
    target.scrollIntoView();
  }

  window.addEventListener("hashchange", reveal);
  document.addEventListener("click", (event) => {
    const link = event.target.closest?.('a[href^="#"]');
    if (link && link.hash === location.hash) reveal();
  });

  const folded = document.querySelectorAll("details");
  const parts = [...document.querySelectorAll("details.part")];
  const unfold = document.getElementById("unfold");
  unfold.hidden = false;
  unfold.addEventListener("click", () => {
    const open = parts.some((part) => !part.open);
    for (const part of parts) part.open = open;
    unfold.textContent = open ? "Fold all sections" : "Open all sections";
  });

  let closed = [];
  window.addEventListener("beforeprint", () => {
    closed = [...folded].filter((one) => !one.open);
    for (const one of closed) one.open = true;
  });
  window.addEventListener("afterprint", () => {
    for (const one of closed) one.open = false;
  });

  reveal();
})();

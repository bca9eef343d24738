"use strict";
for (const table of document.querySelectorAll("table.sortable")) {
  const body = table.tBodies[0];
  table.querySelectorAll("thead button").forEach((button, column) => button.addEventListener("click", () => {
    const head = button.parentElement, up = head.getAttribute("aria-sort") !== "ascending";
    table.querySelectorAll("th").forEach(other => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", up ? "ascending" : "descending");
    const key = row => row.cells[column].dataset.v ?? row.cells[column].textContent.trim();
    const order = (a, b) => {
      const x = key(a), y = key(b);
      if (x === "" || y === "") return (x === "") - (y === "");  // what is missing stands last either way
      const n = Number(x) - Number(y);
      return (Number.isNaN(n) ? x.localeCompare(y, undefined, { numeric: true }) : n) * (up ? 1 : -1);
    };
    body.append(...[...body.rows].sort(order));
  }));
}
const text = document.getElementById("text"), choices = [...document.querySelectorAll(".tools select")];
const count = document.getElementById("count"), rows = [...document.querySelectorAll("#verdicts tbody tr")];
function filter() {
  const words = text.value.toLowerCase().split(/\s+/).filter(Boolean);
  let shown = 0;
  for (const row of rows) {
    const said = row.textContent.toLowerCase();
    row.hidden = !(words.every(w => said.includes(w)) && choices.every(c => !c.value || row.dataset[c.name] === c.value));
    shown += !row.hidden;
  }
  count.textContent = shown === rows.length ? "" : `${shown} of ${rows.length}`;
}
text.addEventListener("input", filter);
choices.forEach(choice => choice.addEventListener("change", filter));

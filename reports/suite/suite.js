/* A suite's page: filters, which the address remembers after #, and rows that open. */
(() => {
  "use strict";
  for (const part of document.querySelectorAll("[data-needs-js]:not(.detail)")) part.hidden = false;
  const rows = [...document.querySelectorAll("tr[data-name]")], find = document.getElementById("find");
  const selects = [...document.querySelectorAll("[data-filter]")], count = document.getElementById("count");
  const below = new Map(rows.map(row => [row, row.nextElementSibling]));
  const button = row => row.querySelector("button.open");
  const filter = () => {
    const words = find.value.toLowerCase().split(/\s+/).filter(Boolean);
    let shown = 0;
    for (const row of rows) {
      const text = row.textContent.toLowerCase();
      row.hidden = !(selects.every(one => !one.value || row.dataset[one.dataset.filter] === one.value) && words.every(word => text.includes(word)));
      below.get(row).hidden = row.hidden || button(row).getAttribute("aria-expanded") !== "true";
      shown += !row.hidden;
    }
    count.textContent = `${shown} of ${rows.length} shown`;
    document.getElementById("none").hidden = shown > 0;
    const chosen = new URLSearchParams([["find", find.value], ...selects.map(one => [one.dataset.filter, one.value])].filter(pair => pair[1]));
    history.replaceState(null, "", chosen.size ? `#${chosen}` : location.pathname);
  };
  const open = row => {
    const opened = button(row).getAttribute("aria-expanded") !== "true";
    button(row).setAttribute("aria-expanded", String(opened));
    below.get(row).hidden = !opened;
  };
  for (const row of rows) row.addEventListener("click", event => {
    if (event.target.closest("button.open") || !event.target.closest("a, button, summary, details")) open(row);
  });
  const asked = new URLSearchParams(location.hash.slice(1));
  find.value = asked.get("find") ?? "";
  for (const one of selects) if ([...one.options].some(option => option.value === asked.get(one.dataset.filter))) one.value = asked.get(one.dataset.filter);
  find.addEventListener("input", filter);
  for (const one of selects) one.addEventListener("change", filter);
  document.getElementById("all").addEventListener("click", () => {
    find.value = "";
    for (const one of selects) one.value = "";
    filter();
  });
  filter();
})();

/* Figures of a comparison: all of them, or those with a verdict. */
(() => {
  "use strict";
  for (const part of document.querySelectorAll("[data-needs-js]")) part.hidden = false;
  const chosen = document.getElementById("verdict"), rows = [...document.querySelectorAll("tr[data-verdicts]")];
  chosen.addEventListener("change", () => {
    for (const row of rows) row.hidden = chosen.value !== "" && !row.dataset.verdicts.split("|").includes(chosen.value);
    document.getElementById("count").textContent = `${rows.filter(row => !row.hidden).length} of ${rows.length} figures shown`;
  });
})();

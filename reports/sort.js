/* Tables of class "sortable": a button in each header sorts by its column; empty keys come last. A row of class
   "detail" stays below the row that it belongs to. */
(() => {
  "use strict";
  for (const table of document.querySelectorAll("table.sortable")) {
    const body = table.tBodies[0], heads = [...table.tHead.rows[0].cells];
    heads.forEach((head, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.className = "sort";
      button.append(...head.childNodes);
      head.append(button);
      button.addEventListener("click", () => {
        const descending = head.getAttribute("aria-sort") === "ascending";
        const key = row => {
          const cell = row.cells[column], text = cell.dataset.key ?? cell.textContent.trim();
          return text === "" ? null : text === String(+text) || !Number.isNaN(+text) ? +text : text;
        };
        const order = (a, b) => {
          const [x, y] = [key(a), key(b)];
          if (x === null || y === null) return (x === null) - (y === null);
          const sign = typeof x === "number" && typeof y === "number" ? x - y : String(x).localeCompare(String(y), undefined, {numeric: true});
          return descending ? -sign : sign;
        };
        const rows = [...body.rows].filter(row => !row.classList.contains("detail"));
        const detail = new Map(rows.map(row => [row, row.nextElementSibling]));
        for (const row of rows.sort(order)) {
          body.append(row);
          if (detail.get(row)?.classList.contains("detail")) body.append(detail.get(row));
        }
        for (const other of heads) other.removeAttribute("aria-sort");
        head.setAttribute("aria-sort", descending ? "descending" : "ascending");
      });
    });
  }
})();

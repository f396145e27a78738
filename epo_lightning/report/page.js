"use strict";
(() => {
  const all = (selector, within = document) => [...within.querySelectorAll(selector)];
  const element = (name, text, className) => {
    const made = document.createElement(name);
    if (text !== undefined) made.textContent = text;
    if (className) made.className = className;
    return made;
  };

  // Sections as tabs; the address remembers which one is open.
  const tabs = all('[role="tab"]');
  const show = (tab, remember) => {
    hide();
    for (const other of tabs) {
      const chosen = other === tab;
      other.setAttribute("aria-selected", chosen);
      other.tabIndex = chosen ? 0 : -1;
      document.getElementById(other.getAttribute("aria-controls")).classList.toggle("shown", chosen);
    }
    tab.scrollIntoView({ block: "nearest", inline: "nearest" });
    if (remember) history.replaceState(null, "", tab.hash);
  };
  const addressed = () => tabs.find((tab) => tab.hash === location.hash) || tabs[0];
  for (const [place, tab] of tabs.entries()) {
    tab.addEventListener("click", (event) => { event.preventDefault(); show(tab, true); });
    tab.addEventListener("keydown", (event) => {
      const step = { ArrowRight: place + 1, ArrowLeft: place - 1, Home: 0, End: tabs.length - 1, " ": place }[event.key];
      if (step === undefined) return;
      event.preventDefault();
      const next = tabs[(step + tabs.length) % tabs.length];
      show(next, true);
      next.focus();
    });
  }
  window.addEventListener("hashchange", () => { show(addressed()); window.scrollTo(0, 0); });

  // Sorting: upwards, downwards, and as it was.
  for (const table of all("table.scores")) {
    const body = table.tBodies[0], original = [...body.rows];
    const key = (row, column) => column ? Number(row.cells[column].dataset.value ?? NaN) : row.cells[0].textContent;
    for (const [column, head] of [...table.tHead.rows[0].cells].entries()) {
      head.querySelector("button").addEventListener("click", () => {
        const before = head.getAttribute("aria-sort");
        for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
        const now = before === null ? "ascending" : before === "ascending" ? "descending" : null;
        if (now) head.setAttribute("aria-sort", now);
        table.classList.toggle("sorted", now !== null);
        const sign = now === "descending" ? -1 : 1;
        const order = (one, other) => {
          const [a, b] = [key(one, column), key(other, column)];
          if (column === 0) return sign * a.localeCompare(b, "en", { numeric: true });
          return Number.isNaN(a) - Number.isNaN(b) || sign * (a - b) || 0;  // what has no number comes last
        };
        body.append(...(now ? [...original].sort(order) : original));
      });
    }
  }

  // What stands behind a number: shown while the pointer is over it, kept by a click.
  const behind = JSON.parse(document.getElementById("behind").textContent);
  const detail = document.getElementById("detail");
  let shown = null, kept = false;
  function hide() {
    if (!shown) return;
    shown.removeAttribute("aria-expanded");
    shown = null;
    kept = false;
    detail.hidden = true;
  }
  const list = (entries) => {
    const made = element("dl");
    for (const [name, value, code] of entries) {
      if (value === null || value === "") continue;
      const text = element("dd");
      text.append(code ? element("code", value) : value);
      made.append(element("dt", name), text);
    }
    return made;
  };
  const fill = (cell, row) => {
    const title = element("h4", row.name);
    title.id = "detail-title";
    const close = element("button", "×", "close");
    close.type = "button";
    close.setAttribute("aria-label", "Close");
    close.addEventListener("click", () => { const from = shown; hide(); from.focus(); });
    const parts = [title, close, element("p", cell.what, "what"), list([
      ["mean", cell.mean], ["std", cell.std ?? "- (one seed)"], ["n", String(cell.n)],
      ["paper", cell.paper], ["ours - paper", cell.difference],
    ])];
    row.runs.forEach((run, i) => parts.push(element("h5", `Seed ${run.seed}: ${cell.values[i]}`), list([
      ["command", run.command, true], ["commit", run.commit, true], ["data", run.digest, true],
      ["trained on", run.trained, true], ["folder", run.folder, true],
    ])));
    detail.replaceChildren(...parts);
    detail.scrollTop = 0;
  };
  const open = (button, keep) => {
    if (shown !== button) {
      hide();
      const cell = behind.cells[Number(button.dataset.cell)];
      fill(cell, behind.rows[cell.row]);
      detail.hidden = false;
      shown = button;
      button.setAttribute("aria-expanded", "true");
      const box = button.getBoundingClientRect(), width = detail.offsetWidth, height = detail.offsetHeight;
      const left = Math.max(12, Math.min(box.right - width, document.documentElement.clientWidth - width - 12));
      const below = box.bottom + 6 + height < innerHeight || box.top < height + 12;
      detail.style.left = `${left + scrollX}px`;
      detail.style.top = `${(below ? box.bottom + 6 : box.top - height - 6) + scrollY}px`;
    }
    kept = kept || keep;
  };
  // On a phone the card would lie over the number and take the pointer from it.
  const hovers = matchMedia("(hover: hover) and (min-width: 641px)");
  for (const button of all("button.cell")) {
    button.addEventListener("click", () => {
      if (shown === button && kept) hide(); else open(button, true);
    });
    button.addEventListener("pointerenter", () => { if (!kept && hovers.matches) open(button, false); });
    button.addEventListener("pointerleave", () => { if (!kept) hide(); });
  }
  document.addEventListener("keydown", (event) => {
    if (event.key !== "Escape" || !shown) return;
    const from = shown;
    hide();
    from.focus();
  });
  document.addEventListener("click", (event) => {
    if (shown && !detail.contains(event.target) && !event.target.closest("button.cell")) hide();
  });

  // Rows of a chart come and go with its legend.
  for (const button of all(".legend button")) {
    button.addEventListener("click", () => {
      const visible = button.getAttribute("aria-pressed") !== "true";
      button.setAttribute("aria-pressed", visible);
      const row = `-row${button.dataset.line}`;
      for (const part of all(`[id$="${row}-line"], [id$="${row}-band"]`, button.closest("figure"))) {
        part.classList.toggle("gone", !visible);
      }
    });
  }

  // Paper cannot be unfolded.
  window.addEventListener("beforeprint", () => { for (const folded of all("details.made")) folded.open = true; });
  show(addressed());
})();

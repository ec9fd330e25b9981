// Defines `checks` in a page: functions that return what is wrong, each as a list of texts.
(() => {
  const MOST = 4;

  const named = (element) => {
    const kind = [element.tagName.toLowerCase(), ...element.classList].join(".");
    const text = (element.innerText || element.getAttribute("src") || "").trim();
    return `${kind} "${[...text.replace(/\s+/g, " ")].slice(0, 50).join("")}"`;
  };

  // The ancestor that cuts an element off, or lets it be scrolled, sideways.
  const holder = (element) => {
    for (let up = element.parentElement; up && up !== document.body; up = up.parentElement) {
      if (getComputedStyle(up).overflowX !== "visible") return up;
    }
    return null;
  };

  const scrolls = (element) => ["auto", "scroll"].includes(getComputedStyle(element).overflowX);

  const settled = () =>
    new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));

  const color = (text) => {
    const [red, green, blue, alpha = 1] = text.match(/[\d.]+/g).map(Number);
    const scale = text.startsWith("color(") ? 255 : 1;
    return [red * scale, green * scale, blue * scale, alpha];
  };

  const over = (top, below) =>
    [0, 1, 2].map((i) => top[3] * top[i] + (1 - top[3]) * below[i]).concat(1);

  const background = (element) => {
    const layers = [];
    for (let up = element; up; up = up.parentElement) {
      layers.push(color(getComputedStyle(up).backgroundColor));
      if (layers.at(-1)[3] === 1) break;
    }
    return layers.reverse().reduce((below, layer) => over(layer, below), [255, 255, 255, 1]);
  };

  // WCAG 2.2, relative luminance and contrast ratio.
  const luminance = (rgb) => {
    const [r, g, b] = rgb.map((c) => {
      const share = c / 255;
      return share <= 0.04045 ? share / 12.92 : ((share + 0.055) / 1.055) ** 2.4;
    });
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const contrast = (one, other) => {
    const [low, high] = [luminance(one), luminance(other)].sort((a, b) => a - b);
    return (high + 0.05) / (low + 0.05);
  };

  window.checks = {
    // Pictures that are not there, or that cannot be read.
    async pictures() {
      const found = await Promise.all(
        [...document.images].map((image) =>
          image.decode().then(
            () => null,
            () => `no picture: ${image.getAttribute("src")}`
          )
        )
      );
      return found.filter(Boolean);
    },

    // What makes the document wider than the screen, or is cut off.
    async overflow(width) {
      await settled();
      const found = [];
      const wide = document.documentElement.scrollWidth;
      if (wide > width) found.push(`the document is ${wide} px wide`);
      for (const element of document.querySelectorAll("body *")) {
        const box = element.getBoundingClientRect();
        if (!box.width || getComputedStyle(element).visibility === "hidden") continue;
        const around = holder(element);
        if (!around) {
          if (box.right > width + 1 && wide > width) found.push(`${named(element)} is too wide`);
        } else if (!scrolls(around) && element.closest("article")) {
          const edge = around.getBoundingClientRect();
          const cut = box.right > edge.right + 1 && edge.width > 1 && element.innerText?.trim();
          if (cut) found.push(`${named(element)} is cut off by ${named(around)}`);
        }
        if (found.length >= MOST) break;
      }
      return found;
    },

    // Tables and code that have to be scrolled sideways.
    async scrolled() {
      await settled();
      const boxes = document.querySelectorAll(
        "article .md-typeset__scrollwrap, article pre, article pre > code, article .equation"
      );
      return [...boxes]
        .filter((box) => scrolls(box) && box.scrollWidth > box.clientWidth + 1)
        .map((box) => `${named(box)} is ${box.scrollWidth} px wide in ${box.clientWidth}`);
    },

    // Text that can hardly be read on its background.
    async contrast(least) {
      await settled();
      const found = new Map();
      const article = document.querySelector("article") || document.body;
      const walk = document.createTreeWalker(article, NodeFilter.SHOW_TEXT);
      while (walk.nextNode()) {
        const element = walk.currentNode.parentElement;
        if (!walk.currentNode.data.trim() || !element.getClientRects().length) continue;
        const style = getComputedStyle(element);
        if (style.opacity === "0" || style.visibility === "hidden") continue;
        const below = background(element);
        const ratio = contrast(over(color(style.color), below), below);
        const key = `${element.tagName}.${element.className} ${style.color}`;
        if (ratio < least && !found.has(key)) {
          found.set(key, `${named(element)}: contrast ${ratio.toFixed(1)}, ${style.color}`);
        }
      }
      return [...found.values()].slice(0, MOST);
    },

    // Titles of what the search of the site finds.
    async search(text) {
      const input = document.querySelector("[data-md-component=search-query]");
      const list = document.querySelector(".md-search-result__list");
      const meta = document.querySelector(".md-search-result__meta");
      const answered = new Promise((done) => {
        const look = () => {
          const items = [...list.querySelectorAll(".md-search-result__item a")];
          if (items.length) done(items.map((item) => [item.innerText.trim(), item.href]));
          else if (/^(No|0) /.test(meta.innerText.trim())) done([]);
        };
        new MutationObserver(look).observe(document.querySelector(".md-search-result"), {
          childList: true,
          subtree: true,
          characterData: true,
        });
      });
      document.querySelector("[data-md-toggle=search]").checked = true;
      input.focus();
      input.value = text;
      input.dispatchEvent(new InputEvent("input", { bubbles: true }));
      input.dispatchEvent(new KeyboardEvent("keyup", { bubbles: true }));
      return answered;
    },
  };
})();

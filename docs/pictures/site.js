/* Names and keyboard for what Material adds to a page in the browser. */
const named = () => {
  document.querySelectorAll(".md-code__nav").forEach((e, i) => e.setAttribute("aria-label", `code ${i + 1}`));
  document.querySelectorAll(".md-typeset__scrollwrap").forEach((e, i) => {
    if (e.scrollWidth <= e.clientWidth) return;
    e.tabIndex = 0;
    e.setAttribute("role", "group");
    e.setAttribute("aria-label", `table ${i + 1}`);
  });
};
new MutationObserver(named).observe(document.body, { childList: true, subtree: true });
addEventListener("resize", named);
named();

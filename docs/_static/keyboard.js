// What the theme leaves out: whatever scrolls can be scrolled by keys, and headings have a level.
addEventListener("DOMContentLoaded", () => {
  for (const scrolling of document.querySelectorAll("pre, .table-wrapper")) scrolling.tabIndex = 0;
  for (const caption of document.querySelectorAll(".caption[role=heading]")) caption.ariaLevel = "2";
});

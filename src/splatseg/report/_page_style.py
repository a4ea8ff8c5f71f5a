"""The style of a page: light and dark, wide and narrow, on paper; nothing is fetched."""

PAGE_STYLE = """
:root { color-scheme: light dark; --paper: #faf9f6; --card: #ffffff; --ink: #20222a;
  --quiet: #5c5f68; --line: #dedcd5; --first: #b9b4a6; --second: #2f7d6d; --third: #c2703d;
  --good: #2f7d6d; --warn: #b3541e; --focus: #1f6feb; }
@media (prefers-color-scheme: dark) {
  :root { --paper: #17181c; --card: #202228; --ink: #e9e7e1; --quiet: #a9abb3; --line: #363941;
    --first: #6a6c76; --second: #58b39f; --third: #dd935f; --good: #58b39f; --warn: #e6a06c;
    --focus: #79b0ff; } }
* { box-sizing: border-box; }
html { scroll-behavior: smooth; }
@media (prefers-reduced-motion: reduce) { html { scroll-behavior: auto; } }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
main { max-width: 1240px; margin: 0 auto; padding: 2.25rem 1.25rem 4rem; }
h1 { font-size: 2rem; line-height: 1.2; margin: 0 0 .5rem; letter-spacing: -.01em; }
h2 { font-size: 1.2rem; margin: 0 0 .5rem; }
h3 { font-size: .95rem; font-weight: 600; margin: 0 0 .35rem; }
h1, h2, h3, td, th, dd, dt, .name, figcaption { overflow-wrap: break-word; }
section { margin-top: 2.5rem; scroll-margin-top: 1rem; }
:focus-visible { outline: 3px solid var(--focus); outline-offset: 2px; border-radius: .2rem; }
nav { display: flex; flex-wrap: wrap; gap: .15rem 1rem; margin-top: 1.25rem; padding-top: .75rem;
  border-top: 1px solid var(--line); font-size: .88rem; }
nav a { color: var(--quiet); text-decoration: none; padding: .15rem 0; }
nav a:hover { color: var(--ink); text-decoration: underline; }
.summary { max-width: 46rem; margin: 0; color: var(--quiet); font-size: 1.05rem; }
.made { max-width: 60rem; margin: .5rem 0 0; font-size: .85rem; color: var(--quiet); }
.option { white-space: nowrap; } .made code { overflow-wrap: break-word; }
.note { max-width: 46rem; margin: 0 0 .75rem; color: var(--quiet); font-size: .9rem; }
.notice { max-width: 60rem; margin: 1rem 0 0; padding: .7rem 1rem; background: var(--card);
  border: 1px solid var(--line); border-left: .3rem solid var(--good); border-radius: .4rem; }
.notice.warn { border-left-color: var(--warn); }
.notice b { color: var(--good); } .notice.warn b { color: var(--warn); }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(11rem, 1fr));
  gap: .75rem; }
.figure { padding: .8rem 1rem; background: var(--card); border: 1px solid var(--line);
  border-radius: .6rem; }
.figure .label { color: var(--quiet); font-size: .85rem; }
.figure .value { font-size: 1.6rem; font-weight: 650; line-height: 1.3;
  font-variant-numeric: tabular-nums; }
.figure .note { margin: .15rem 0 0; font-size: .82rem; }
.wide { overflow-x: auto; }
.tall { max-height: 32rem; overflow-y: auto; border-bottom: 1px solid var(--line); }
.tall thead th { position: sticky; top: 0; background: var(--paper); }
table { border-collapse: collapse; }
th, td { text-align: left; padding: .35rem .9rem .35rem 0; border-bottom: 1px solid var(--line);
  vertical-align: top; }
thead th { color: var(--quiet); font-weight: 550; font-size: .88rem; }
.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
figure { margin: 0; min-width: 0; }
figcaption { color: var(--quiet); font-size: .8rem; margin-top: .2rem; }
figcaption b { color: var(--ink); font-weight: 550; }
img { display: block; width: 100%; height: auto; border-radius: .3rem; }
.row, .key { margin-top: 1rem; }
.row h3 small { color: var(--quiet); font-weight: 450; }
.shots { display: grid; gap: .6rem;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, var(--least-width, 14.5rem)), 1fr)); }
.frame { position: relative; width: 100%; aspect-ratio: var(--aspect-ratio); }
.zoom { display: block; position: static; margin: 0; padding: 0; border: 0; width: 100%;
  height: auto; background: none; color: inherit; overflow: visible; }
.zoom .bar { display: none; }
.zoom:popover-open { position: fixed; inset: 0; margin: auto; padding: .7rem;
  width: fit-content; height: fit-content; max-width: 100vw; max-height: 100vh; overflow: auto;
  background: var(--card); border-radius: .6rem; }
.zoom:popover-open img { width: min(94vw, calc(82vh * var(--aspect-ratio))); }
.zoom:popover-open .bar { display: flex; gap: 1rem; justify-content: space-between;
  align-items: center; padding-top: .5rem; font-size: .9rem; }
.zoom::backdrop { background: rgba(0, 0, 0, .72); }
.bar button { font: inherit; color: inherit; background: var(--paper); cursor: pointer;
  border: 1px solid var(--line); border-radius: .35rem; padding: .2rem .8rem; }
.flat { image-rendering: pixelated; }
.open { position: absolute; inset: 0; width: 100%; height: 100%; padding: 0; border: 0;
  background: none; cursor: zoom-in; }
.objects { list-style: none; margin: 0; padding: 0; display: grid; gap: .75rem;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 10.5rem), 1fr)); }
.objects li { background: var(--card); border: 1px solid var(--line); border-radius: .5rem;
  padding: .5rem; min-width: 0; content-visibility: auto; contain-intrinsic-size: 9.5rem 16rem; }
.objects h3 { margin: .4rem 0 .2rem; line-height: 1.3; }
.objects h3 i, .keys i { display: inline-block; width: .85em; height: .85em; border-radius: .2em;
  margin-right: .4em; vertical-align: -.08em; }
.objects dl { gap: 0 .6rem; font-size: .8rem; }
.objects .long { grid-column: 1 / -1; }
.objects dt.long { position: absolute; width: 1px; height: 1px; overflow: hidden;
  clip-path: inset(50%); }
.objects .unseen { display: grid; place-items: center; aspect-ratio: 1; background: var(--paper);
  color: var(--quiet); font-size: .8rem; text-align: center; border-radius: .3rem; }
.keys { display: flex; flex-wrap: wrap; gap: .3rem 1.1rem; font-size: .9rem;
  margin-bottom: .75rem; }
.scale { display: grid; grid-template-columns: auto minmax(6rem, 18rem) auto; gap: .6rem;
  align-items: center; justify-content: start; margin: .9rem 0 0;
  font-size: .85rem; color: var(--quiet); }
.scale i { height: .8rem; border-radius: .2rem; border: 1px solid var(--line); }
.bars { display: grid; grid-template-columns: max-content minmax(6rem, 40rem);
  gap: .5rem 1rem; align-items: center; }
.bars .name { font-size: .92rem; }
.bar-line { display: flex; align-items: center; gap: .5rem; height: 1rem; }
.bar-line i { height: .6rem; border-radius: .15rem; min-width: 1px; }
.bar-line b { font-weight: 450; font-size: .78rem; color: var(--quiet);
  font-variant-numeric: tabular-nums; }
.series0 { background: var(--first); } .series1 { background: var(--second); }
.series2 { background: var(--third); }
.charts { display: grid; gap: 1rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 18rem), 1fr)); }
.charts figcaption { font-size: .92rem; color: var(--ink); }
svg { display: block; width: 100%; height: auto; }
svg text { fill: var(--quiet); font-size: 11px; font-variant-numeric: tabular-nums; }
svg .grid { stroke: var(--line); stroke-width: 1; }
svg polyline { fill: none; stroke-width: 1.8; stroke-linejoin: round; }
.line0 { stroke: var(--second); } .line1 { stroke: var(--third); }
.dot0 { fill: var(--second); } .dot1 { fill: var(--third); }
pre { margin: 0; padding: .9rem 1rem; overflow-x: auto; background: var(--card);
  border: 1px solid var(--line); border-radius: .6rem;
  font: .85rem/1.6 ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; }
code { font: .92em ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; }
dl { display: grid; grid-template-columns: max-content minmax(0, 1fr); gap: .25rem 1.25rem;
  margin: 0; font-size: .9rem; }
dt { color: var(--quiet); } dd { margin: 0; }
@media (max-width: 480px) { main { padding: 1.25rem .9rem 3rem; } h1 { font-size: 1.5rem; }
  .figures { grid-template-columns: 1fr 1fr; } .figure .value { font-size: 1.3rem; }
  .bars { grid-template-columns: 1fr; gap: .15rem; } .bars .group { margin-bottom: .4rem; }
  section dl { grid-template-columns: minmax(0, 1fr); gap: 0; }
  section dl dd { margin-bottom: .4rem; } .objects li dl { grid-template-columns: auto 1fr; }
  .objects li dl dd { margin: 0; }
  .objects, .shots { grid-template-columns: 1fr 1fr; } }
@media print { body { background: none; }
  .wide { overflow: visible; max-height: none; } nav { display: none; }
  .objects li { content-visibility: visible; } }
"""

"""How the page of a diagnosis looks: on a phone, on paper, in light and in dark."""

from __future__ import annotations

LEVELS = ((1.5, "as chance would"), (3.0, "1.5 to 3"), (6.0, "3 to 6"), (15.0, "6 to 15"))
"""Upper ends of the classes of disagreement, in standard deviations; above the last is one more."""
ABOVE = "above 15"


def level(value: float) -> int:
    """The class of a disagreement."""
    return sum(value >= end for end, _ in LEVELS)


STYLE = """
:root {
  color-scheme: light dark;
  --paper: #ffffff; --ink: #1b2430; --soft: #5a6675; --line: #d9dfe6; --card: #f5f7f9;
  --before: #b4530a; --after: #1a66b8; --band: #dce6f0; --road: #d3d9e0;
  --d0: #7fa98a; --d1: #e0c15a; --d2: #ea8f3c; --d3: #cf4733; --d4: #7d1128;
  --good: #1f7a4d; --mixed: #9a5b00; --bad: #a3283c;
}
@media screen and (prefers-color-scheme: dark) {
  :root {
    --paper: #12161b; --ink: #e5eaf0; --soft: #9ba8b6; --line: #2d3640; --card: #1a2027;
    --before: #f0a35e; --after: #6db3f2; --band: #26364a; --road: #3a444f;
    --d0: #4f7a5c; --d1: #b59a3c; --d2: #e08a3c; --d3: #f0604a; --d4: #ff9fb4;
    --good: #63c796; --mixed: #e6b25c; --bad: #f08496;
  }
}
* { box-sizing: border-box; }
body {
  margin: 0 auto; max-width: 62rem; padding: 1rem 1rem 3rem; background: var(--paper);
  color: var(--ink); font: 1rem/1.5 system-ui, "Segoe UI", Roboto, Arial, sans-serif;
  overflow-wrap: anywhere;
}
h1 { font-size: 1.5rem; line-height: 1.3; margin: .4rem 0 .6rem; }
h2 { font-size: 1.15rem; margin: 2.4rem 0 .5rem; padding-bottom: .2rem;
  border-bottom: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.2rem 0 .3rem; }
p { margin: .4rem 0; max-width: 46rem; }
.soft, figcaption, caption, th { color: var(--soft); }
.soft, figcaption { font-size: .9rem; }
.badge { display: inline-block; padding: .1rem .6rem; border-radius: 1rem; color: var(--paper);
  font-weight: 600; font-size: .9rem; background: var(--soft); }
.badge.explained, .badge.no_discrepancy { background: var(--good); }
.badge.partially_explained, .badge.not_identifiable { background: var(--mixed); }
.badge.unknown { background: var(--bad); }
.partial { border: 2px solid var(--mixed); border-radius: .4rem; padding: .5rem .8rem;
  font-weight: 600; }
.note { background: var(--card); border-left: 4px solid var(--line); padding: .5rem .8rem; }
table { border-collapse: collapse; width: 100%; font-size: .94rem; }
caption { text-align: left; font-size: .9rem; padding-bottom: .2rem; }
th { text-align: left; font-weight: 600; font-size: .85rem; vertical-align: bottom; }
th, td { padding: .3rem .7rem .3rem 0; border-bottom: 1px solid var(--line); }
td { vertical-align: top; }
td:not(.n, [data-label=rank]) { min-width: 5.6rem; }
td[data-label=rank] { white-space: nowrap; }
.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
tr.best td { font-weight: 600; }
details { margin: .6rem 0; }
summary { cursor: pointer; color: var(--soft); }
.maps { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(20rem, 100%), 1fr));
  gap: 1rem; margin: 0; }
figure { margin: 0; }
.maps:has(svg.wide) { grid-template-columns: minmax(0, 1fr); }
.maps svg { width: 100%; height: auto; max-height: 34rem; background: var(--card);
  border-radius: .4rem; display: block; }
svg text { fill: var(--ink); }
.road { fill: none; stroke: var(--road); }
.lane { fill: none; stroke-linecap: butt; }
.d0 { stroke: var(--d0); background: var(--d0); } .d1 { stroke: var(--d1); background: var(--d1); }
.d2 { stroke: var(--d2); background: var(--d2); } .d3 { stroke: var(--d3); background: var(--d3); }
.d4 { stroke: var(--d4); background: var(--d4); }
.place { paint-order: stroke; stroke: var(--card); stroke-linejoin: round; font-weight: 600; }
.key { display: flex; flex-wrap: wrap; gap: .2rem 1rem; font-size: .9rem; margin: .5rem 0; }
.key i { display: inline-block; width: 1.4rem; height: .55rem; margin-right: .35rem; }
.strips { display: grid; gap: 0; font-size: .92rem; }
.strip { display: grid; grid-template-columns: minmax(0, 27rem) minmax(0, 1fr); gap: 0 1rem;
  align-items: center; padding: .25rem 0; border-bottom: 1px solid var(--line);
  break-inside: avoid; }
.strip small { display: block; color: var(--soft); font-variant-numeric: tabular-nums; }
.strip svg { width: 100%; height: 22px; display: block; overflow: visible; }
.strip svg text { font-size: 11px; fill: var(--soft); }
.band { fill: var(--band); } .axis { stroke: var(--line); }
.way { stroke: var(--soft); stroke-width: 1.5; }
.dot-before { fill: var(--paper); stroke: var(--before); stroke-width: 2.5; }
.dot-after { fill: var(--after); stroke: var(--after); }
.bar { height: .6rem; background: var(--after); border-radius: .2rem; min-width: 2px; }
.other .bar { background: var(--soft); }
.big { display: grid; grid-template-columns: repeat(auto-fit, minmax(8.5rem, 1fr)); gap: .6rem; }
.big div { background: var(--card); border-radius: .4rem; padding: .5rem .8rem; }
.big b { display: block; font-size: 1.2rem; font-variant-numeric: tabular-nums;
  white-space: nowrap; }
.big span { font-size: .85rem; color: var(--soft); }
pre { background: var(--card); border-radius: .4rem; padding: .7rem .9rem; margin: .5rem 0;
  font-size: .88rem; white-space: pre-wrap; overflow-wrap: anywhere; }
code { font-family: ui-monospace, "DejaVu Sans Mono", Menlo, monospace; font-size: .88em; }
dl { display: grid; grid-template-columns: max-content minmax(0, 1fr); gap: .15rem 1rem;
  font-size: .92rem; margin: .5rem 0; }
dt { color: var(--soft); } dd { margin: 0; }
@media screen and (max-width: 40rem) {
  h1 { font-size: 1.25rem; }
  dl { grid-template-columns: minmax(0, 1fr); }
  dd { margin-bottom: .3rem; }
  .strip { grid-template-columns: minmax(0, 1fr); }
  .stack thead { position: absolute; clip-path: inset(50%); height: 1px; overflow: hidden; }
  .stack, .stack tbody, .stack tr, .stack td { display: block; }
  .stack tr { border-bottom: 1px solid var(--line); padding: .4rem 0; }
  .stack td { border: 0; padding: .05rem 0; display: grid; text-align: left; white-space: normal;
    grid-template-columns: 6.5rem minmax(0, 1fr); gap: .6rem; min-width: 0; }
  .stack td::before { content: attr(data-label); color: var(--soft); font-size: .85rem; }
  .stack td:empty { display: none; }
}
@media print {
  html { font-size: 9.5pt; }
  body { max-width: none; padding: 0; }
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
  tr, figure, p, .big, .note, .key, pre { break-inside: avoid; }
  h2, h3, h2 + p, h3 + p, .key { break-after: avoid; }
  details::details-content { content-visibility: visible; block-size: auto; }
  summary { list-style: none; }
}
"""

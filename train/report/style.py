"""The pages' style sheet: light and dark, on a phone and on paper."""

from typing import Final

_LIGHT: Final = """
  --paper: #fbfbf9; --card: #ffffff; --ink: #1d232b; --soft: #5c6672; --line: #e3e5e8; --grid: #d9dce0;
  --arm0: #d1601f; --arm1: #1a6fb5; --arm2: #3d8b5f; --arm3: #8f5bb3; --arm4: #8a7a1e; --arm5: #b0447a;
  --hazard: #6f7fd6; --goal: #2c8f4e; --vase: #2aa5ad; --mark: #e0a100; --bad: #d0202e; --good: #1d7f45;
"""
_DARK: Final = """
  --paper: #15181c; --card: #1d2126; --ink: #e6e8eb; --soft: #9aa4af; --line: #31373f; --grid: #3a4149;
  --arm0: #f28e52; --arm1: #62b0ef; --arm2: #6cc490; --arm3: #c394e6; --arm4: #cfbd55; --arm5: #ea86b6;
  --hazard: #8796f0; --goal: #5cc981; --vase: #56cdd4; --mark: #ffc93c; --bad: #ff6a73; --good: #63d391;
"""

STYLE: Final = (
    ":root {"
    + _LIGHT
    + """  --film-bare: #78808a; --film-changed: #f0b214; --film-violated: #d62834;
}
@media screen and (prefers-color-scheme: dark) { :root {"""
    + _DARK
    + """} }
* { box-sizing: border-box; }
body {
  margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif;
}
main { max-width: 1080px; margin: 0 auto; padding: 32px 20px 64px; }
h1 { font-size: 28px; margin: 0; letter-spacing: -0.01em; overflow-wrap: anywhere; }
h2 { font-size: 20px; margin: 44px 0 14px; letter-spacing: -0.005em; }
h3 { font-size: 15px; font-weight: 600; margin: 0; line-height: 1.3; overflow-wrap: anywhere; }
a { color: var(--arm1); }
header p, section > p, li { color: var(--soft); font-size: 15px; }
header p { margin: 4px 0 0; }
.verdict { font-size: 20px; line-height: 1.45; margin: 22px 0; max-width: 52em; text-wrap: pretty; }
p.line { color: var(--soft); font-size: 14px; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(180px, 1fr)); gap: 14px; }
.cards.returns { grid-template-columns: repeat(auto-fit, minmax(220px, 1fr)); margin-bottom: 14px; }
.card, figure, pre {
  margin: 0; padding: 14px 16px;
  background: var(--card); border: 1px solid var(--line); border-radius: 10px;
}
.card h3 { color: var(--soft); font-size: 14px; }
.card p { margin: 0; font-size: 14px; }
.card .value { font-size: 34px; font-weight: 700; line-height: 1.3; font-variant-numeric: tabular-nums; }
.card .other { color: var(--soft); }
article.card { margin-bottom: 14px; }
article.card h3 { font-size: 17px; }
article.card p { font-size: 16px; margin-top: 6px; }
article.card .other { font-size: 14px; }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 420px), 1fr)); gap: 14px; }
.films { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 480px), 1fr)); gap: 14px; }
.figures, .films { margin-bottom: 14px; }
/* Title, keys, drawing and sentence stand at the same height as the neighbour's. */
figure {
  display: grid; grid-template-rows: subgrid; grid-row: span 4; row-gap: 8px; min-width: 0; align-items: start;
}
.films figure { grid-row: span 3; }
figcaption { font-size: 14px; color: var(--soft); }
.told { grid-row: span 4; align-self: start; }
.told h3 { color: inherit; font-size: 15px; }
.figures .told p { color: var(--soft); margin-top: 8px; }
svg { width: 100%; height: auto; display: block; }
svg text { font-family: inherit; }
img { width: 100%; height: auto; display: block; border-radius: 6px; }
.figures p, .films p { margin: 0; }
.keys { font-size: 13px; margin: 0; line-height: 1.7; }
section > .keys { margin-bottom: 8px; }
.key { display: inline-block; margin-right: 14px; }
.key i { display: inline-block; margin-right: 6px; vertical-align: middle; border: 0 solid var(--mark-color); }
.key .fill { width: 11px; height: 11px; border-radius: 3px; background: var(--mark-color); }
b.good, .value.good { color: var(--good); }
b.bad, .value.bad { color: var(--bad); }
.key .ring { width: 11px; height: 11px; border-radius: 6px; border-width: 2px; }
.key .disc { width: 11px; height: 11px; border-radius: 6px; background: var(--mark-color); }
.key .line, .key .dot { width: 20px; height: 0; border-top-width: 3px; }
.key .dot { border-top-style: dotted; }
a.csv { font-size: 13px; white-space: nowrap; }
a.number { color: inherit; text-decoration: underline dotted; text-underline-offset: 3px; }
a.number:hover { color: var(--arm1); }
.numbers {
  display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 420px), 1fr)); gap: 4px 28px; margin: 0;
}
.numbers > div { padding: 6px 8px; margin: 0 -8px; border-radius: 6px; scroll-margin-top: 12px; }
.numbers > div:target { background: color-mix(in srgb, var(--mark) 18%, transparent); }
.numbers dt { font-size: 15px; font-weight: 600; }
.numbers dd { margin: 0; font-size: 14px; color: var(--soft); }
.numbers code { font-size: 12px; color: var(--soft); font-weight: 400; overflow-wrap: anywhere; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: 15px; }
th, td { text-align: right; padding: 6px 10px; border-bottom: 1px solid var(--line); white-space: nowrap; }
thead th { font-size: 13px; color: var(--soft); font-weight: 600; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
.words td { white-space: normal; overflow-wrap: anywhere; vertical-align: top; }
.words td + td { text-align: left; }
.runs { font-size: 14px; }
.runs th, .runs td { padding: 6px 7px; }
.runs th:first-child { padding-left: 0; }
.runs thead th { white-space: normal; vertical-align: bottom; }
.short th:first-child { position: sticky; left: 0; background: var(--paper); }
tbody th { font-weight: 400; }
.condition th, .arm th { font-weight: 700; padding-top: 14px; }
.experiment th { font-size: 17px; font-weight: 700; padding-top: 18px; }
small { color: var(--soft); font-size: 13px; }
details { margin: 10px 0; }
summary { cursor: pointer; font-weight: 600; }
pre { overflow-x: auto; font-size: 14px; }
@media (max-width: 600px) {
  main { padding: 20px 12px 40px; }
  .verdict { font-size: 18px; }
  .cards { grid-template-columns: repeat(auto-fit, minmax(140px, 1fr)); gap: 10px; }
  .card .value { font-size: 28px; }
  figure { padding: 10px; }
}
@media print {
  main { max-width: none; padding: 0; }
  .figures { grid-template-columns: 1fr 1fr; }
  figure, .card, tr { break-inside: avoid; }
  h2 { break-after: avoid; }
  body { font-size: 12px; }
  .wide { overflow: visible; }
  table, small, thead th { font-size: 10px; }
  th, td { padding: 3px 5px; }
}
"""
)

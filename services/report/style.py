"""Style sheet of the report, for a screen, a phone and A4; legible in grey."""

from services.common.language import Language

_CSS = """
@page { size: A4; margin: 8mm 15mm 11mm; @bottom-right { content: "PAGE_NUMBER";
  font: 8pt "DejaVu Sans", Verdana, Arial, sans-serif; color: #5b6570; } }
* { box-sizing: border-box; }
body { font: 10.5pt/1.38 "DejaVu Sans", Verdana, Arial, sans-serif; color: #1b1f24;
  max-width: 190mm; margin: 0 auto; padding: 8mm; background: #fff; }
h1 { font-size: 19pt; margin: 0; overflow-wrap: anywhere; }
h2 { font-size: 12pt; margin: 4mm 0 1mm; }
h3 { font-size: 11pt; margin: 4mm 0 0; }
p, ul { margin: 1mm 0; }
ul { padding-left: 5mm; }
.sub { color: #5b6570; }
.finding { border: 1.2pt solid #5b6570; border-left-width: 6pt; padding: 2mm 3mm; margin: 2.5mm 0; }
.finding strong { font-size: 12.5pt; }
.finding ul { border-top: 0.5pt solid #b9bfc5; margin: 1.5mm 0 0; padding-top: 1mm; }
.finding.weak { border-color: #8a4b00; background: #fdf0d5; }
.finding.sound { border-color: #00694d; background: #eef7f3; }
.finding.open, .finding.known { background: #f3f5f7; }
.finding.doubtful { border-style: dashed; border-left-style: double; background: #f1f1f1; }
.finding.nothing { border-style: dashed; border-color: #c0392b; background: #f6e1de; }
table { border-collapse: collapse; width: 100%; margin: 1.5mm 0; font-size: 9pt; }
th, td { text-align: left; padding: 0.6mm 2mm 0.6mm 0; vertical-align: top;
  border-bottom: 0.5pt solid #d5dade; overflow-wrap: anywhere; }
thead th { overflow-wrap: normal; }
.facts th { width: 30mm; font-weight: normal; color: #5b6570; }
tr.weak td { font-weight: bold; background: #fdf0d5; }
figure { margin: 1.5mm 0; }
svg { width: 100%; height: auto; display: block; }
.note { font-size: 9pt; color: #3d4650; }
.first ul { font-size: 9pt; }
.about { display: flex; gap: 4mm; align-items: flex-start; }
.about .facts { flex: 1; min-width: 0; }
.sketch { flex: 0 0 36mm; }
.sketch svg { overflow: visible; }
.sketch text { font: 14.5px "DejaVu Sans", Verdana, Arial, sans-serif; fill: #3d4650; }
.option { white-space: nowrap; }
.wide { overflow-x: auto; }
.wide th:first-child { white-space: nowrap; }
.first .wide td { white-space: nowrap; }
.measures td { white-space: nowrap; }
.measures td:first-child { padding-right: 4mm; }
.measures td:last-child { white-space: normal; font-size: 0.94em; color: #3d4650; }
.many.measures td:first-child { white-space: normal; width: 44%; }
.many.measures td:last-child { font-size: inherit; color: inherit; white-space: nowrap; }
.measures small { color: #3d4650; }
.signature { border-bottom: 0.8pt solid #5b6570; padding-bottom: 6mm; margin-top: 3mm;
  font-size: 9pt; color: #5b6570; }
.words { border-top: 0.8pt solid #5b6570; font-size: 9pt; margin-top: 3mm; }
tr.suspect td:first-child::before { content: "○ "; }
tr.rejected td:first-child::before { content: "× "; }
tr.good td:first-child::before { content: "● "; }
@media screen {
  .first .wide td:nth-last-child(-n+2) { white-space: normal; overflow-wrap: break-word; }
}
@media screen and (max-width: 700px) {
  body { padding: 4mm; }
  h1 { font-size: 16pt; }
  .about { flex-wrap: wrap; }
  .about .facts { flex-basis: 100%; }
  .facts th { width: 24mm; }
  .wide table { width: max-content; min-width: 100%; }
  .wide td { max-width: 62mm; overflow-wrap: break-word; }
  figure.wide svg { width: 640px; }
}
@media print {
  body { padding: 0; font-size: 9.2pt; line-height: 1.28; }
  h1 { display: inline; margin-right: 3mm; font-size: 15pt; }
  .first .sub { display: inline-block; margin: 0; font-size: 8pt; }
  .finding { padding: 1.2mm 3mm; margin: 1.5mm 0; }
  .finding strong { font-size: 11.5pt; }
  figure, tr, .finding { break-inside: avoid; }
  .past, .words + .first { break-before: page; }
  .evidence table { font-size: 8.2pt; }
  .evidence th, .evidence td { padding-top: 0.3mm; padding-bottom: 0.3mm; }
  .measures table { font-size: 7.8pt; }
  .measures small { font-size: 7pt; }
  .measures td, .measures th { padding-top: 0.2mm; padding-bottom: 0.2mm; line-height: 1.25; }
  .note.how { display: none; }
  .past figure svg { max-height: 175mm; }
  .wide { overflow: visible; }
  h2, h3 { break-after: avoid; margin: 1.5mm 0 0; }
  h2 { font-size: 11pt; }
  .first p, .first ul { margin: 0.6mm 0; }
  .words { columns: 3; column-gap: 5mm; font-size: 7pt; line-height: 1.2; margin-top: 2mm; }
  .words h2 { font-size: 10pt; margin: 1mm 0 0; column-span: all; }
  .words p { margin: 0.5mm 0; }
  .finding p { margin: 0.3mm 0; }
  .note, .first ul, .evidence ul { font-size: 7.4pt; line-height: 1.22; }
  .first { font-size: 8.6pt; }
  .first table { font-size: 8.2pt; line-height: 1.22; margin: 1mm 0; }
  .first th, .first td { padding-top: 0.3mm; padding-bottom: 0.3mm; }
  .sketch { flex-basis: 30mm; margin: 0; }
  .signature { margin: 1.5mm 0 0; padding-bottom: 3.5mm; font-size: 8pt;
    break-inside: avoid; break-before: avoid; }
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
}
"""


def style_sheet(language: Language) -> str:
    """Return the style sheet; its page numbers are in the language."""
    number = language.text("page.number", page='" counter(page) "', pages='" counter(pages) "')
    return _CSS.replace("PAGE_NUMBER", number)

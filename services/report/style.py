"""How the report looks, on a screen and on A4; legible in grey."""

CSS = """
@page { size: A4; margin: 14mm 15mm; }
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
.finding.weak { border-color: #8a4b00; background: #fdf0d5; }
.finding.sound { border-color: #00694d; background: #eef7f3; }
.finding.open { background: #f3f5f7; }
.finding.doubtful { border-style: dashed; border-left-style: double; background: #f1f1f1; }
.finding.nothing { border-style: dashed; border-color: #c0392b; background: #f6e1de; }
table { border-collapse: collapse; width: 100%; margin: 1.5mm 0; font-size: 9pt; }
th, td { text-align: left; padding: 0.6mm 2mm 0.6mm 0; vertical-align: top;
  border-bottom: 0.5pt solid #d5dade; overflow-wrap: anywhere; }
.facts th { width: 30mm; font-weight: normal; color: #5b6570; }
tr.weak td { font-weight: bold; background: #fdf0d5; }
figure { margin: 1.5mm 0; }
svg { width: 100%; height: auto; display: block; }
.note { font-size: 9pt; color: #3d4650; }
.first ul { font-size: 9pt; }
.words { border-top: 0.8pt solid #5b6570; font-size: 9pt; margin-top: 3mm; }
.crossing { border-top: 0.8pt solid #5b6570; padding-bottom: 2mm; }
.crossing.suspect h3::before { content: "○ "; }
.crossing.rejected h3::before { content: "× "; }
.crossing.good h3::before { content: "● "; }
@media print {
  body { padding: 0; font-size: 9.5pt; }
  .break { break-before: page; }
  .evidence { break-after: avoid; }
  .crossing table { font-size: 8.4pt; }
  .first + .break + .crossing { break-before: avoid; }
  .past + .break + .crossing { break-before: avoid; }
  .crossing + .first { break-before: page; }
  figure, tr, .finding { break-inside: avoid; }
  .past { break-before: page; }
  .past figure svg { max-height: 175mm; }
  .first figure svg { max-height: 44mm; }
  .crossing figure svg { max-height: 85mm; }
  .crossing { break-inside: avoid; }
  h2 { margin-top: 2mm; }
  .words { columns: 2; column-gap: 6mm; font-size: 7.5pt; line-height: 1.22; margin-top: 1mm; }
  .words h2 { font-size: 10pt; margin: 1mm 0 0; }
  .words p { break-inside: avoid; margin: 0.5mm 0; }
  .finding p { margin: 0.3mm 0; }
  .note, .first ul { font-size: 8pt; line-height: 1.25; }
  .first table { font-size: 8.6pt; margin: 1mm 0; }
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
}
"""

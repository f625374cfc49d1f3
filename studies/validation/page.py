"""The page docs/validation.md, from the results of a validation of method `pre`."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

from schemas.validation_records import METHOD_EDITION
from studies.validation.calibration import SMALLEST_P, Record, StudyTarget, by_condition
from studies.validation.misspecification import HEADINGS, cells, effect_checks, lines_of
from studies.validation.uncertainty import (
    JUDGED,
    ValidationOutcome,
    control_checks,
    judged_checks,
    largest_z,
    noises,
    number,
    percent,
    reasons_of,
    scenario_rows,
    summary,
    targets,
)

_HEAD = """# Validation of method `pre`

Are the 95 % intervals reliable? This page is written by

    {command} --page docs/validation.md

(`make validate WORLDS={each}`); all its figures come from that run, of method version {edition}.
No real bridge is among the crossings: no public recording of one is known.

## Targets

Errors are judged in ln EI, in which the prior is normal: z = (ln median − ln truth) over the
standard deviation that the 2.5 and 97.5 % quantiles give. The bound is the Cramér–Rao bound of the
same residuals, receiver and priors at the truth, where the variance of a restraint is that of a
normal truncated at zero, without absence, so standard deviations can be smaller. Standard errors
(±) follow from the scatter between crossings.

{targets}

{missed} of {all} targets are missed.{unlisted}
"""

_UNLISTED = """ Those of the tables on out-of-model effects and an independent simulator are
listed only where missed. Met of them: {met}."""

_DRAWN = """
## Crossings drawn from the priors

{crossings} crossings, seeds 0 to {last}. For each, every parameter of the method is drawn from its
prior by the site file: the truck (log-normal, 15 %), EI of every element
(log-normal, 0.55 of ln EI), mass per length (10 %), Rayleigh damping (50 %), rotational restraint
and bearing compliance (half-normal; absent in half of the draws), tyre damping (half-normal),
wheelbase (0.2 %), gains (1 %) and delays (0.5 ms) of the channels, the total mass
(1 %) and the gain common to all channels (1 %), the receiver's slow error (1.5 m), noise and
latency (0.1 s), the height of the centre of gravity (15 %). No draw is truncated or discarded.
Sensors have biases of 0.03 m/s², rates of 200 to 2000 Hz and a declared noise of 25 to 100 µg/√Hz;
receivers give one or ten fixes a second. Roads are of ISO class A or B; speeds are 5 to 25 m/s in
both directions, four in ten with accelerations of 0.1 to 1 m/s². Both axles follow one road
profile; in the row `surface` [below](#out-of-model-effects) they do not.

The truth is computed with ten finite elements for each element, 40 modes and steps of 0.1 ms. Tyres
average the road over their contact patch; the signals are measured, put into messages and read by
the engine that reads recordings. Mesh, time step, integrator and exact position are not the
method's, but the model is: a linear half-car on a beam at rest. Whether real trucks and bridges
follow it is not tested here.

![Errors, coverage, ranks and widths]({image})

The common scale uncertainty (total mass, gain) is part of both the interval and the truth.

{elements}

| | least | 5 % | median | 95 % | most |
| --- | --: | --: | --: | --: | --: |
{distributions}

| crossings | number | good | coverage | rms z |
| --- | --: | --: | --: | --: |
{conditions}

Verdicts and reasons: {reasons}.

Ranks: with correct intervals the share of the posterior below the truth is uniform. Each parameter
is tested by χ² over ten bins; a group fails if its smallest p-value times their number is below
{smallest_p:g}.
"""

_CONTROL = """
## Negative control

The same crossings, seeds 0 to {last}, with half of their noise declared: {good} of {count} are
`good`, {named} of {count} have a reason that names the misfit (`noise_above_declared`,
`model_misfit` or `residuals_coloured`).
"""

_SCENARIOS = """
## The paper's scenarios

One crossing each at 10 m/s over a road of class A, with errors of the receiver (1.5 m slow; 0.4 m
and 0.07 m/s white); the truck is that of the site file. Road and noise have the scenario's number
as seed. The table shows EI over the undamaged value, mean ± standard deviation,
and the paper's Table 7 (no noise, exact position; its ± is the spread of particles).

| scenario | element | truth | paper | {columns} |
| --: | --- | --: | --: | {rules} |
{rows}

{verdicts}
"""

_WORLDS = """
## Out-of-model effects

Trucks and bridges are drawn as above, but with free and rigid bearings and undamped tyres; then one
effect is added, or all but surface, torsion, left-and-right and pavement, which have roads of their
own (`studies/simulation/out_of_model.py` explains the effects and gives their ranges, none of which
is a prior of the method). `answered` crossings are not rejected; `covered` is the share of the 95 %
intervals of EI that contain the truth, in answered crossings and in good ones (`of good`). z is
the error of ln EI, as above: its mean over all elements and that of the worst element, its root
mean square (`rms`), and its largest size in good crossings (`max`).
`std` is the median relative standard deviation of EI, for the surface also over its
bound (`of bound`).

| {headings} |
| --- |{rules}
{rows}

{reasons}
"""

_JUDGED = """
## Crossings of an independent simulator

The files are from a program that shares no code with this one. The error of EI may be the larger of
a share of its value and a number of standard deviations (`allowed`).

| run | verdict | χ² | at the truth | allowed | error | largest \\|z\\| | std/bound |
| --- | --- | --: | --: | --- | --: | --: | --: |
{rows}
"""

_NOT_JUDGED = """
## Crossings of an independent simulator

Not judged in this run: their folder does not exist.
"""

_ELSEWHERE = """
## Other evidence

| what | against | page |
| --- | --- | --- |
| beam, modes, moving loads | closed forms, another integrator, orders of convergence | [forward problem](../studies/forward-problem.md) |
| truck on bridge, the paper's search | the paper's tables, a simulator that shares no code | [reproduction](../studies/reproduction.md) |
| verdicts | faults, one by one | [faults](../studies/faults.md) |
| fused intervals, forecasts, weak elements | whole simulated surveys | [surveys](../studies/surveys.md) |
| verdicts and intervals | VBI-2D and OpenSeesPy | [other simulators](../studies/other-simulators.md) |
| sensors left and right | a simulator of both sides | [sensors](../studies/sensors.md) |
"""  # noqa: E501 - a row of Markdown is one line


def validation_page(outcome: ValidationOutcome, image: str = "images/calibration.png") -> str:
    """Return the page as Markdown."""
    in_tables = [check for line in outcome.judged for check in judged_checks(line)]
    in_tables += effect_checks(outcome.out_of_model)
    listed = targets(outcome._replace(judged=[], out_of_model=()))
    listed += [check for check in in_tables if not check.is_met]
    text = _HEAD.format(
        command=_command(outcome),
        each=_each(outcome),
        edition=METHOD_EDITION,
        targets=_targets(listed),
        missed=sum(not check.is_met for check in listed),
        all=len(targets(outcome)),
        unlisted=_unlisted(in_tables),
    )
    if len(outcome.drawn) > 1:
        text += _drawn(outcome, image)
    if outcome.control:
        text += _control(outcome)
    if outcome.scenarios:
        text += _scenarios(outcome)
    if outcome.out_of_model:
        text += _effects_section(outcome.out_of_model)
    text += _judged(outcome) if outcome.judged else _NOT_JUDGED
    return text + _ELSEWHERE


def _command(outcome: ValidationOutcome) -> str:
    """Return the command, with its numbers of crossings."""
    return (
        f"driveby validate --method pre --crossings {len(outcome.drawn)} "
        f"--control {len(outcome.control)} --out-of-model {_each(outcome)}"
    )


def _each(outcome: ValidationOutcome) -> int:
    """Return the number of crossings of each effect."""
    effects = dict.fromkeys(record["effect"] for record in outcome.out_of_model)
    return len(outcome.out_of_model) // max(1, len(effects))


def _effects_section(records: Sequence[Record]) -> str:
    lines = lines_of(records)
    of_effect = {
        line.effect: [record for record in records if record["effect"] == line.effect]
        for line in lines
    }
    reasons = [
        f"{effect}: {', '.join(reasons_of(of))}"
        for effect, of in of_effect.items()
        if any(record["verdict"] != "good" for record in of)
    ]
    return _WORLDS.format(
        headings=" | ".join(HEADINGS),
        rules=" --: |" * (len(HEADINGS) - 1),
        rows="\n".join(f"| {' | '.join(cells(line))} |" for line in lines),
        reasons="Verdicts and reasons: " + "; ".join(reasons) + ".",
    )


def _targets(checks: list[StudyTarget]) -> str:
    rows = ["| target | measured | wanted | |", "| --- | --: | --: | --- |"]
    for check in checks:
        measured = "none" if check.measured is None else f"{check.measured:.3g}"
        note = f" ({check.note})" if check.note else ""
        wanted = _wanted(check)
        name = check.name.replace("|", "\\|")
        rows.append(
            f"| {name} | {measured}{note} | {wanted} | {'met' if check.is_met else '**missed**'} |"
        )
    return "\n".join(rows)


def _unlisted(in_tables: Sequence[StudyTarget]) -> str:
    """Return how many targets of each effect and simulated run are met; "" without any."""
    all_of = Counter(check.name.split(":")[0] for check in in_tables)
    met_of = Counter(check.name.split(":")[0] for check in in_tables if check.is_met)
    met = ", ".join(f"{name}: {met_of[name]} of {count}" for name, count in all_of.items())
    return _UNLISTED.format(met=met) if met else ""


def _wanted(check: StudyTarget) -> str:
    if check.low == check.high:
        return f"{check.low:g}"
    if check.low == 0.0:
        return f"≤ {check.high:g}"
    # Shares and p-values end at one in any case.
    return f"≥ {check.low:g}" if check.high == 1.0 else f"{check.low:g} to {check.high:g}"


def _drawn(outcome: ValidationOutcome, image: str) -> str:
    records = outcome.drawn
    found = summary(records)
    return _DRAWN.format(
        crossings=len(records),
        last=len(records) - 1,
        image=image,
        elements=_elements(found),
        distributions="\n".join(
            f"| {_LABELS[key]} | " + " | ".join(_short(v) for v in values.values()) + " |"
            for key, values in found["distributions"].items()
            if values is not None
        ),
        conditions="\n".join(
            f"| {name} | {count} | {percent(good)} | {percent(covered)} | {number(rms)} |"
            for name, count, good, covered, rms in by_condition(records)
        ),
        reasons=", ".join(reasons_of(records)),
        smallest_p=SMALLEST_P,
    )


_LABELS = {
    "chi2_per_dof": "χ² per degree of freedom",
    "r_hat": "R-hat",
    "ess": "effective sample size",
    "acceptance": "acceptance",
    "seconds": "seconds, one process of two",
    "starts": "starts of the search",
    "road_z": "rms error of the road, without bend, over its std",
}


def _short(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def _elements(found: dict[str, Any]) -> str:
    head = "| element | " + " | ".join(str(e + 1) for e in range(found["elements"])) + " |"
    rules = "| --- |" + " --: |" * found["elements"]
    rows = [
        ("within the 95 % interval", [percent(v) for v in found["coverage"]]),
        ("rms z", [number(v) for v in found["rms"]]),
        ("mean std over mean bound", [number(v) for v in found["std_over_bound"]]),
        ("median bound of ln EI", [percent(v) for v in found["bound"]]),
    ]
    return "\n".join([head, rules, *(f"| {name} | {' | '.join(cells)} |" for name, cells in rows)])


def _control(outcome: ValidationOutcome) -> str:
    good, named = control_checks(outcome.control)
    count = len(outcome.control)
    return _CONTROL.format(
        last=count - 1,
        count=count,
        good=round(count * (good.measured or 0.0)),
        named=round(count * (named.measured or 0.0)),
    )


def _scenarios(outcome: ValidationOutcome) -> str:
    columns = [f"{noise:g} µg/√Hz" for noise in noises(outcome)]
    verdicts = [
        f"{line['scenario']} at {line['noise_ug_per_rthz']:g}: {line['verdict']}"
        + (f" ({', '.join(line['reasons'])})" if line["reasons"] else "")
        for line in outcome.scenarios
        if line["verdict"] != "good"
    ]
    return _SCENARIOS.format(
        columns=" | ".join(columns),
        rules=" | ".join("--:" for _ in columns),
        rows="\n".join(f"| {' | '.join(row)} |" for row in scenario_rows(outcome)),
        verdicts="Not good: " + "; ".join(verdicts) + "." if verdicts else "All are `good`.",
    )


def _judged(outcome: ValidationOutcome) -> str:
    rows = []
    for line in outcome.judged:
        tolerance = JUDGED[line["folder"]]
        elements = [e for e in line["elements"].values() if "mean" in e]
        error = max((abs(e["mean"] / e["truth"] - 1.0) for e in elements), default=None)
        ratio = max((e["std"] / e["bound"] for e in elements), default=None)
        rows.append(
            f"| {line['folder']} {line['run']} | {line['verdict']} | "
            f"{number(line['chi2_per_dof'])} | {number(line['chi2_at_truth'])} | "
            f"{tolerance.share:.0%} or {tolerance.stds:g} std | {percent(error)} | "
            f"{number(largest_z(line))} | {number(ratio)} |"
        )
    return _JUDGED.format(rows="\n".join(rows))

"""A crossing on a road surface, at its truth: under equal tyres, or twin ones behind."""

from functools import cache

from pre_core.crossing import posterior
from pre_core.crossing.fit import Optimum
from pre_core.search import levenberg_marquardt
from pre_core.search.loop import Termination
from schemas.settings import IdentificationSettings
from services.simulation.data_alone import crossing_data_only
from services.simulation.drawn import drive
from services.simulation.survey_kinds import KINDS
from studies.simulation.truths import default_site
from studies.validation.bound import at_truth
from studies.validation.surveys import crossing_truth, site_of_truck


@cache
def at_its_truth(of: str = "single-5") -> Optimum:
    """Return the truth of a crossing of five elements as if a search had ended there."""
    kind = KINDS[of]._replace(elements=5)
    site = site_of_truck(default_site(), kind, 0)
    truth, seed = crossing_truth(site, kind, 0, 0, 0)
    one = drive(site, truth, seed)
    settings = IdentificationSettings(method="pre", threads=1)
    (seen,) = crossing_data_only([one.run], one.site, settings)
    problem, y = at_truth(seen, one)
    state = levenberg_marquardt.initial_state(lambda at: posterior.all_rows(problem, at), y)
    return Optimum(problem, state, Termination.CONVERGED, 1.0, 0, 1)

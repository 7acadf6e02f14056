"""From tracks to physics: the numbers of the paper's section IV, with error bars."""

from sphereorient.statistics.bootstrap import Interval
from sphereorient.statistics.flow import Surroundings
from sphereorient.statistics.moments import Moments, table_of_moments
from sphereorient.statistics.segments import Ensemble, ensemble_of
from sphereorient.statistics.settings import BootstrapSettings, SegmentSettings, StatisticsSettings
from sphereorient.statistics.summary import Summary, summarise

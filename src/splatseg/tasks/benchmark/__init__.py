"""Published protocols run over methods: fit, see, segment, score, one table."""

from splatseg.tasks.benchmark.options import BenchOptions as BenchOptions
from splatseg.tasks.benchmark.results import MethodResult as MethodResult
from splatseg.tasks.benchmark.results import SceneResult as SceneResult
from splatseg.tasks.benchmark.results import check_comparable as check_comparable
from splatseg.tasks.benchmark.results import load_result as load_result
from splatseg.tasks.benchmark.run import BenchRun as BenchRun
from splatseg.tasks.benchmark.run import bench as bench
from splatseg.tasks.benchmark.tables import bench_table as bench_table
from splatseg.tasks.benchmark.tables import write_tables as write_tables

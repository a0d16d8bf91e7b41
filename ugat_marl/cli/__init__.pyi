from .arguments import LengthS as LengthS
from .baseline import baseline_command as baseline_command
from .frame import CommandLine as CommandLine
from .frame import guarded as guarded
from .frame import run as run

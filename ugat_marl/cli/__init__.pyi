from .arguments import LengthS as LengthS
from .frame import CommandLine as CommandLine
from .frame import guarded as guarded
from .frame import run as run

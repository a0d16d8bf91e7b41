from .data import TransitionLog as TransitionLog
from .effects import load_scenario as load_scenario
from .envs import TrafficEnv as TrafficEnv
from .envs import env as env
from .envs import parallel_env as parallel_env
from .envs import vector_env as vector_env

__version__: str

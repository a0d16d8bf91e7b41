from .data import TransitionLog as TransitionLog
from .effects import load_scenario as load_scenario
from .envs import TrafficEnv as TrafficEnv
from .envs import env as env
from .envs import parallel_env as parallel_env
from .envs import vector_env as vector_env
from .experiments.functions import Training as Training
from .experiments.functions import evaluate as evaluate
from .experiments.functions import train as train
from .policies import load_policy as load_policy

__version__: str

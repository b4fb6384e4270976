from .candidates import Constraints as Constraints
from .identify import (
    identify as identify,
)
from .next_views import (
    next_views as next_views,
)
from .optimal_design import (
    AOptimal as AOptimal,
    DOptimal as DOptimal,
    SingleParameter as SingleParameter,
)
from .profile import (
    profile as profile,
)

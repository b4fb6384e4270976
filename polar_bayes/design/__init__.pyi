from .candidates import Constraints as Constraints
from .identify import (
    identifiability_sentences as identifiability_sentences,
    identifiability_table as identifiability_table,
    identify as identify,
)
from .next_views import (
    next_views as next_views,
    next_views_sentences as next_views_sentences,
    next_views_table as next_views_table,
)
from .optimal_design import (
    AOptimal as AOptimal,
    DOptimal as DOptimal,
    SingleParameter as SingleParameter,
)
from .profile import (
    profile as profile,
    profile_sentences as profile_sentences,
    profile_table as profile_table,
)

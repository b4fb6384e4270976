from .choose import (
    choose_effects as choose_effects,
    ChosenScene as ChosenScene,
    ledger_summary as ledger_summary,
)

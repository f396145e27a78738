"""Runtime checks of annotations: beartype, for which an int is a float wherever Python says so (PEP 484)."""

from beartype import BeartypeConf, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True))

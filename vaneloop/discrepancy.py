"""The former name of `vaneloop.identification`, for one version."""

import sys

from vaneloop.identification.user_models.user_code import FormerName

sys.modules[__name__] = FormerName(__name__, __doc__)

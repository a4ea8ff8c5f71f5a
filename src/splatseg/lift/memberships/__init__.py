"""How much of each Gaussian belongs to each segment, solved for through what pixels show."""

from splatseg.lift.memberships.fit import DEFAULT_MEMBERSHIPS as DEFAULT_MEMBERSHIPS
from splatseg.lift.memberships.fit import MembershipOptions as MembershipOptions
from splatseg.lift.memberships.fit import fit_memberships as fit_memberships

"""What all tests share: property tests draw the same examples every time, and are not timed one by one."""

from hypothesis import settings

settings.register_profile("drivesem", deadline=None, derandomize=True, database=None)
settings.load_profile("drivesem")

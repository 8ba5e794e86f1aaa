"""Names of the files of an export to C.  Imports nothing."""

C_FILES = ("koz_math.h", "koz_policy.h", "koz_policy.c", "koz_selftest.c", "Makefile")
SHIELD_FILES = ("koz_shield.h", "koz_shield.c", "koz_shield_selftest.c")

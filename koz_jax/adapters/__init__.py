"""The environment behind the contracts of other libraries."""

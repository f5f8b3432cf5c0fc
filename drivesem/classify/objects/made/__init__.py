"""The twelve classes made by code: each a few kinds, each kind a family of proportions and colours."""

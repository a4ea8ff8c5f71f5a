"""Adapters of networks of the library transformers: loading, preparing images, asking.

The library's own image processors are not used: half of them need torchvision, which is never
needed here and where it is broken takes the whole library with it.
"""

"""What the report and the studio show in a browser alike: arrays for scripts, shapes of limbs, scripts.

``static`` holds the scripts and style sheets, and below ``vendor`` the libraries they use (VENDOR.md).
Nothing here knows a study or a page.
"""

"""Images to label maps: limb, bones, fat, and what is not the limb."""

"""The example meshes (bunny, chair, vase) and the assets baked from them."""

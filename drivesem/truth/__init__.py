"""Is a failure one? Kinds, margins, what a camera does between two frames, certificates, second renderers."""

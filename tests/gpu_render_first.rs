#![cfg(feature = "cuda")]
#![allow(missing_docs, clippy::unwrap_used)]
#[path = "gpu/render.rs"]
mod render;

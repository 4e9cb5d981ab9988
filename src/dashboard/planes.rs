//! Layers of the newest frame, for the page's overlays and for scripts.

use super::access::parameter;
use super::hub::message;
use super::pixels::{NO_CELLS, Pixels, Refusal, Sent, bad, refused};
use crate::publish::{Layer, histogram, plane};
use axum::http::header::CONTENT_TYPE;
use axum::http::{StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use std::sync::Arc;
use std::time::Duration;
use tokio::time::timeout;

/// Planes that are made or on their way at once, each of 8.4 MB at most.
pub(super) const MAX_PLANES: usize = 4;
/// Longest wait for one of these places. A page asks for one plane at a time, so that nobody else waits behind it.
const PLANE_WAIT: Duration = Duration::from_secs(4);

impl Pixels {
    /// Answers with a layer of a frame as a message: length and JSON of its [head](crate::publish::PlaneHead), then its values.
    pub async fn plane(&self, uri: &Uri) -> Response {
        self.encoded_plane(uri).await.unwrap_or_else(refused)
    }

    /// Answers with how often the frame shows each FTLE, as JSON.
    pub async fn histogram(&self, uri: &Uri) -> Response {
        let counted = self.needed_frame(uri).await.and_then(|(frame, _)| {
            serde_json::to_string(&histogram(&frame)).map_err(|error| (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()))
        });
        counted.map_or_else(refused, |json| ([(CONTENT_TYPE, "application/json")], json).into_response())
    }

    async fn encoded_plane(&self, uri: &Uri) -> Result<Response, Refusal> {
        let name = parameter(uri, "of").unwrap_or_default();
        let layer = Layer::named(name).ok_or_else(|| bad("of", name, Layer::NAMES))?;
        // What cannot be met does not wait for a place.
        let (frame, _) = self.needed_frame(uri).await?;
        if layer == Layer::Trusted && frame.gate.is_none() && self.is_beside && frame.record.surrogate.is_some() {
            return Err((StatusCode::NOT_FOUND, NO_CELLS.to_owned()));
        }
        let busy = || (StatusCode::SERVICE_UNAVAILABLE, "other planes are on their way: try again in some seconds".to_owned());
        let permit = timeout(PLANE_WAIT, Arc::clone(&self.planes).acquire_owned()).await.map_err(|_| busy())?.map_err(|_| busy())?;
        // By now it may be a later one.
        let (frame, _) = self.frame(uri)?;
        let encode = move || {
            let (head, values) = plane(&frame, layer);
            serde_json::to_string(&head).map(|json| message(&json, &values))
        };
        let failed = |error: String| (StatusCode::INTERNAL_SERVER_ERROR, format!("the plane cannot be made: {error}"));
        let encoded = tokio::task::spawn_blocking(encode).await.map_err(|error| failed(error.to_string()))?;
        let bytes = encoded.map_err(|error| failed(error.to_string()))?;
        Ok(([(CONTENT_TYPE, "application/octet-stream")], Bytes::from_owner(Sent::new(bytes, permit))).into_response())
    }
}

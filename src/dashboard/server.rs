//! HTTP: the page, its files, and the WebSocket.

use super::access::{Access, Refused, Rights, given_token};
use super::hub::Hub;
use super::pixels::File;
use super::{client, files, metrics};
use axum::body::Body;
use axum::extract::{FromRequestParts, Request, WebSocketUpgrade};
use axum::http::header::{
    ALLOW, CACHE_CONTROL, CONTENT_LENGTH, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HeaderMap, HeaderName, HeaderValue, REFERRER_POLICY,
    TRANSFER_ENCODING, X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{Method, StatusCode};
use axum::response::{IntoResponse, Response};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use std::convert::Infallible;
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::time::timeout;

/// Maximum number of HTTP connections. Those of open pages, which are WebSockets by then, are counted elsewhere.
const MAX_CONNECTIONS: usize = 128;
/// Time for the head of a request.
const HEAD_TIMEOUT: Duration = Duration::from_secs(10);
/// Time after which an HTTP connection ends, also of a browser that does not read. A browser opens the next one by itself.
const CONNECTION_TIMEOUT: Duration = Duration::from_secs(60);
/// Further time of one on which a file is sent.
const DOWNLOAD_TIMEOUT: Duration = Duration::from_secs(600);
/// Maximum length of the head of a request, in bytes, and number of its fields.
const MAX_HEAD_BYTES: usize = 16 << 10;
const MAX_HEAD_FIELDS: usize = 64;
/// Maximum length of what a page says, in bytes.
const MAX_SAID_BYTES: usize = 1024;
/// Pause after a connection could not be accepted, because no descriptor is free for instance.
const PAUSE: Duration = Duration::from_millis(100);

/// Scripts, styles and connections of this server alone; `ws:` since some browsers do not count a WebSocket as `'self'`.
const POLICY: &str = "default-src 'self'; img-src 'self' blob:; connect-src 'self' ws: wss:; style-src 'self'; base-uri 'none'; \
     form-action 'none'; frame-ancestors 'self'";
const NO_FIELD: Refused = "This token only watches: it has no field traced.\n";
/// In every answer.
const HEADERS: [(HeaderName, HeaderValue); 4] = [
    (CACHE_CONTROL, HeaderValue::from_static("no-store")),
    (CONTENT_SECURITY_POLICY, HeaderValue::from_static(POLICY)),
    (REFERRER_POLICY, HeaderValue::from_static("no-referrer")),
    (X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff")),
];

/// Serves browsers. Never ends.
pub(super) async fn serve(listener: TcpListener, access: Access, hub: Arc<Hub>) {
    let (access, places) = (Arc::new(access), Arc::new(Semaphore::new(MAX_CONNECTIONS)));
    loop {
        let Ok((stream, _)) = listener.accept().await else {
            tokio::time::sleep(PAUSE).await;
            continue;
        };
        // Without a place the connection is closed.
        let Ok(place) = Arc::clone(&places).try_acquire_owned() else { continue };
        let (access, hub) = (Arc::clone(&access), Arc::clone(&hub));
        tokio::spawn(async move {
            let downloads = AtomicBool::new(false);
            let mut connection = pin!(connection(stream, &access, &hub, &downloads));
            if timeout(CONNECTION_TIMEOUT, &mut connection).await.is_err() && downloads.load(Ordering::Relaxed) {
                let _ = timeout(DOWNLOAD_TIMEOUT, connection).await;
            }
            drop(place);
        });
    }
}

/// Answers the requests of a connection, until it ends or becomes a WebSocket. Notes whether a file was asked for.
async fn connection(stream: TcpStream, access: &Access, hub: &Arc<Hub>, downloads: &AtomicBool) {
    // Small messages follow large ones.
    let _ = stream.set_nodelay(true);
    let service = service_fn(|request: hyper::Request<hyper::body::Incoming>| async {
        let is_file = matches!(OfFrames::named(request.uri().path()), Some(OfFrames::File(_) | OfFrames::Field));
        let response = answer(request.map(Body::new), access, Arc::clone(hub)).await;
        if is_file && response.status() == StatusCode::OK {
            downloads.store(true, Ordering::Relaxed);
        }
        Ok::<_, Infallible>(response)
    });
    let served = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD_TIMEOUT)
        .max_buf_size(MAX_HEAD_BYTES)
        .max_headers(MAX_HEAD_FIELDS)
        .serve_connection(TokioIo::new(stream), service)
        .with_upgrades()
        .await;
    if let Err(error) = served {
        // Without the request, whose path holds the token.
        tracing::debug!("a connection of the dashboard ended: {error}");
    }
}

async fn answer(request: Request, access: &Access, hub: Arc<Hub>) -> Response {
    let mut response = match respond(request, access, hub).await {
        Ok(response) => response,
        Err(refused) => (StatusCode::FORBIDDEN, refused).into_response(),
    };
    response.headers_mut().extend(HEADERS);
    response
}

/// What is served of the newest frame.
enum OfFrames {
    File(File),
    Plane,
    Histogram,
    Values,
    Field,
}

impl OfFrames {
    fn named(path: &str) -> Option<Self> {
        match path.rsplit('/').next() {
            Some("plane") => Some(Self::Plane),
            Some("histogram") => Some(Self::Histogram),
            Some("values") => Some(Self::Values),
            Some("field.nc") => Some(Self::Field),
            _ => File::named(path).map(Self::File),
        }
    }
}

/// Answers by the end of the path, since some proxies put a prefix before it.
async fn respond(request: Request, access: &Access, hub: Arc<Hub>) -> Result<Response, Refused> {
    let (mut parts, _) = request.into_parts();
    access.check_host(&parts.headers)?;
    if parts.method != Method::GET && parts.method != Method::HEAD {
        return Ok((StatusCode::METHOD_NOT_ALLOWED, [(ALLOW, "GET, HEAD")]).into_response());
    }
    if has_body(&parts.headers) {
        return Ok((StatusCode::PAYLOAD_TOO_LARGE, "The request has a body; accepted: requests without one.\n").into_response());
    }
    let path = parts.uri.path();
    if path.ends_with('/') {
        // The page holds no data: without a token it says how to get one. It learns here why a WebSocket was refused.
        if given_token(&parts.uri).is_some() {
            access.check_token(&parts.uri)?;
        }
        return Ok(file(files::PAGE).into_response());
    }
    if path.ends_with("/socket") {
        access.check_origin(&parts.headers)?;
        let rights = access.check_token(&parts.uri)?;
        let token_to_share = access.token_to_share(rights).map(str::to_owned);
        return Ok(match WebSocketUpgrade::from_request_parts(&mut parts, &()).await {
            Ok(upgrade) => upgrade
                .max_message_size(MAX_SAID_BYTES)
                .max_frame_size(MAX_SAID_BYTES)
                .on_upgrade(move |socket| client::serve(socket, hub, token_to_share)),
            Err(rejection) => rejection.into_response(),
        });
    }
    if path.ends_with("/metrics") {
        access.check_origin(&parts.headers)?;
        access.check_token_or_bearer(&parts.uri, &parts.headers)?;
        return Ok(([(CONTENT_TYPE, metrics::MEDIA_TYPE)], hub.metrics()).into_response());
    }
    if path.ends_with("/chart.svg") {
        access.check_origin(&parts.headers)?;
        access.check_token(&parts.uri)?;
        return Ok(match &hub.chart {
            Some(chart) => ([(CONTENT_TYPE, "image/svg+xml; charset=utf-8")], chart.clone()).into_response(),
            None => (StatusCode::NOT_FOUND, "There is no chart of this scene: ridgewatch chart SCENE draws one.\n").into_response(),
        });
    }
    if path.ends_with("/past") || path.ends_with("/past.json") {
        access.check_origin(&parts.headers)?;
        access.check_token(&parts.uri)?;
        return Ok(match &hub.history {
            Some(history) if path.ends_with("/past") => history.picture(&parts.uri).await,
            Some(history) => history.list().await,
            None => {
                (StatusCode::NOT_FOUND, "The folder of the run is not known: ridgewatch dashboard --run FOLDER names it.\n").into_response()
            }
        });
    }
    if let Some(wanted) = OfFrames::named(path) {
        access.check_origin(&parts.headers)?;
        let rights = access.check_token(&parts.uri)?;
        return Ok(match wanted {
            // It takes processors from the run.
            OfFrames::Field if rights != Rights::Steer => return Err(NO_FIELD),
            OfFrames::Field if parts.method != Method::GET => (StatusCode::METHOD_NOT_ALLOWED, [(ALLOW, "GET")]).into_response(),
            OfFrames::Field => hub.pixels.field(&parts.uri),
            OfFrames::File(file) => hub.pixels.download(file, &parts.uri).await,
            OfFrames::Plane => hub.pixels.plane(&parts.uri).await,
            OfFrames::Histogram => hub.pixels.histogram(&parts.uri).await,
            OfFrames::Values => hub.pixels.values(&parts.uri).await,
        });
    }
    Ok(match files::named(path) {
        Some(found) => file(found).into_response(),
        None => (StatusCode::NOT_FOUND, "There is no such file.\n").into_response(),
    })
}

/// Whether more than a head comes.
fn has_body(headers: &HeaderMap) -> bool {
    headers.contains_key(TRANSFER_ENCODING) || headers.get_all(CONTENT_LENGTH).iter().any(|length| length.as_bytes() != b"0")
}

fn file(file: files::File) -> impl IntoResponse {
    ([(CONTENT_TYPE, file.media_type)], file.bytes)
}

//! A store behind HTTP or HTTPS: one GET for each part, or for a range of one, with bounds on time, tries, redirects and bytes.

use super::super::messages::FormatFault;
use super::parts::{METADATA, Parts, Span, checked};
use std::env::var;
use std::io::Read;
use std::net::Ipv4Addr;
use std::path::Path;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};
use ureq::Agent;
use ureq::config::RedirectAuthHeaders;
use ureq::http::Response;
use ureq::tls::{PemItem, RootCerts, TlsConfig, parse_pem};

/// Requests at once: at a latency of 200 ms, 50 MB/s are 10 MB on their way.
const CONNECTIONS: usize = 16;
/// Tries of a request.
const TRIES: u32 = 4;
/// Pause before the second try; each later one is four times as long.
const PAUSE: Duration = Duration::from_millis(200);
/// Longest pause that a server may ask for.
const MAX_PAUSE: Duration = Duration::from_secs(10);
/// Redirects that one request follows.
const REDIRECTS: u32 = 4;
/// Seconds that a part may take with all its tries, beside a second for each [`SLOWEST`] bytes.
const LIMIT: u64 = 60;
/// The same for metadata, a few of which have to come within the time that opening may take.
const METADATA_LIMIT: Duration = Duration::from_secs(25);
const SLOWEST: u64 = 256 << 10;
/// Bytes of a part that are passed over to reach a range, if the server knows no ranges.
const MAX_SKIPPED: u64 = 64 << 20;
/// Bytes of an error's body that are read, so that its connection can serve the next request.
const ERROR_BYTES: u64 = 64 << 10;
/// Bytes of a file of certificates.
const MAX_CERTIFICATES: u64 = 16 << 20;

/// What is accepted of URLs, for messages.
pub const ACCEPTED_URLS: &str = "URLs of Zarr stores, such as `https://HOST/PATH/x.zarr`";

/// Whether a path is a URL. `checked_url` says whether it is accepted.
pub fn is_url(path: &Path) -> bool {
    let scheme = path.to_str().and_then(|text| text.split_once("://")).map_or("", |(scheme, _)| scheme);
    !scheme.is_empty() && scheme.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"+-.".contains(&byte))
}

/// The URL of a store as it is shown and recorded: without a slash at its end.
///
/// # Errors
/// What may be shown of it, since it may hold a secret, and what is wrong.
pub fn checked_url(url: &str) -> Result<String, (String, String)> {
    let (scheme, rest) = url.split_once("://").unwrap_or(("", url));
    let known = rest.split(['?', '#']).next().unwrap_or_default();
    let shown = format!("{scheme}://{}", if rest.contains('@') { "..." } else { known });
    let refused = |what: &str| Err((shown.clone(), what.to_owned()));
    if !["http", "https"].iter().any(|known| scheme.eq_ignore_ascii_case(known)) {
        let accepted = "accepted are `https://` and `http://`; object stores have such URLs too";
        return refused(&format!("{accepted}: `https://BUCKET.s3.REGION.amazonaws.com/KEY`, `https://storage.googleapis.com/BUCKET/KEY`"));
    }
    let (authority, path) = known.split_once('/').unwrap_or((known, ""));
    if authority.contains('@') {
        let accepted = "it names a user, and messages and records show URLs: leave out what is before `@`, and set";
        return refused(&format!("{accepted} {AUTHORIZATION}=\"HOST VALUE\", where VALUE is that of the header `Authorization`"));
    }
    if known.len() < rest.len() {
        return refused("it goes on with `?` or `#`: URLs are no patterns, and queries, which may hold secrets, are not accepted");
    }
    if path.contains(['*', '[', ']', '{', '}']) {
        return refused("it is a pattern, but HTTP lists no files: name each store");
    }
    let (host, port) = host_and_port(authority);
    if host.is_empty() || port.parse::<u16>().is_err() || url.contains(|c: char| c.is_whitespace() || c.is_control() || c == '\\') {
        return refused("it has no host, a port that is none, or spaces or `\\`, which are written `%20` and `%5C`");
    }
    Ok(url.trim_end_matches('/').to_owned())
}

/// A host, with the brackets of an address, and its port, which may be left out.
fn host_and_port(authority: &str) -> (&str, &str) {
    match authority.rsplit_once(':') {
        // A colon within brackets belongs to the address.
        Some((host, port)) if !port.ends_with(']') => (host, port),
        _ => (authority, "80"),
    }
}

/// The host of a URL that was checked, with its port.
fn authority(url: &str) -> &str {
    url.split("://").nth(1).and_then(|rest| rest.split('/').next()).unwrap_or_default()
}

/// Whether a host is this machine, so that nothing leaves it.
fn is_local(host: &str) -> bool {
    host.eq_ignore_ascii_case("localhost") || host == "[::1]" || host.parse::<Ipv4Addr>().is_ok_and(|address| address.is_loopback())
}

/// The environment variable of the header `Authorization` for one host.
const AUTHORIZATION: &str = "RIDGEWATCH_HTTP_AUTHORIZATION";
/// The environment variable of the seconds that a part may take.
const LIMIT_VARIABLE: &str = "RIDGEWATCH_HTTP_LIMIT";

/// A store behind a URL.
pub struct HttpParts {
    agent: &'static Agent,
    url: String,
    /// Value of the header `Authorization`.
    authorization: Option<String>,
    limit: Duration,
    /// Whether its server is on this machine.
    local: bool,
    /// Metadata that were read: they are there.
    known: OnceLock<String>,
    /// Whether metadata were answered with 403.
    denied: AtomicBool,
    /// Whether no further tries are wanted.
    given_up: AtomicBool,
    requests: AtomicU64,
}

/// Why a try failed.
enum Fault {
    /// Another try may help, not before this time.
    Passing(String, Option<Duration>),
    Lasting(String),
}

impl HttpParts {
    /// A store behind a URL that was checked.
    ///
    /// # Errors
    /// Settings of the environment that are not accepted.
    pub fn open(url: &str) -> Result<Self, FormatFault> {
        let refused = FormatFault::Refused;
        let limit = match var(LIMIT_VARIABLE) {
            Ok(text) => text
                .parse()
                .ok()
                .filter(|seconds| (1..=3600).contains(seconds))
                .ok_or_else(|| refused(format!("{LIMIT_VARIABLE} = {text:?}: accepted is a whole number of seconds from 1 to 3600")))?,
            Err(_) => LIMIT,
        };
        let authorization = match var(AUTHORIZATION) {
            Ok(text) => authorization(url, &text).map_err(refused)?,
            Err(_) => None,
        };
        Ok(Self {
            agent: agent(is_https(url)).map_err(FormatFault::Refused)?,
            url: url.to_owned(),
            authorization,
            limit: Duration::from_secs(limit),
            local: is_local(host_and_port(authority(url)).0),
            known: OnceLock::new(),
            denied: AtomicBool::new(false),
            given_up: AtomicBool::new(false),
            requests: AtomicU64::new(0),
        })
    }

    /// One request, up to the header of its answer.
    fn get(&self, name: &str, range: Option<&str>, deadline: Instant) -> Result<Response<ureq::Body>, Fault> {
        self.requests.fetch_add(1, Ordering::Relaxed);
        let left = deadline.saturating_duration_since(Instant::now()).max(Duration::from_millis(1));
        let silence = (self.limit / 3).min(left);
        let request = self.agent.get(format!("{}/{}", self.url, encoded(name))).config();
        let request = request.timeout_global(Some(left)).timeout_per_read(Some(silence)).timeout_recv_response(Some(silence));
        let mut request = request.timeout_resolve(Some(silence)).timeout_connect(Some(silence.min(Duration::from_secs(10))));
        if self.local {
            // A proxy would be another machine, which might even be sent a credential unencrypted.
            request = request.proxy(None);
        }
        let mut request = request.build();
        for (header, value) in [("Range", range), ("Authorization", self.authorization.as_deref())] {
            if let Some(value) = value {
                request = request.header(header, value);
            }
        }
        request.call().map_err(|error| fault(&error))
    }

    /// One try to read a part.
    fn attempt(&self, name: &str, span: Span, most: u64, deadline: Instant) -> Result<Option<Vec<u8>>, Fault> {
        let range = match span {
            Span::All => None,
            Span::Last(bytes) => Some(format!("bytes=-{bytes}")),
            Span::From(start, bytes) => Some(format!("bytes={start}-{}", start + bytes - 1)),
        };
        let mut response = self.get(name, range.as_deref(), deadline)?;
        let status = response.status().as_u16();
        let header = |name: &str| response.headers().get(name).and_then(|value| value.to_str().ok());
        match status {
            200 | 206 => {}
            _ => {
                let pause = retry_after(&response);
                drain(&mut response);
                return self.refusal(name, status, pause);
            }
        }
        let plain = |coding: &str| coding.is_empty() || coding.eq_ignore_ascii_case("identity");
        if let Some(coding) = header("content-encoding").map(str::trim).filter(|coding| !plain(coding)) {
            let coding: String = coding.chars().take(40).collect();
            return Err(Fault::Lasting(format!("it is sent with the coding {coding:?}, though none was asked for")));
        }
        let announced = response.body().content_length();
        let Some(range) = range else {
            if status == 206 {
                return Err(Fault::Passing("a part of it was sent, though all was asked for".into(), None));
            }
            if let Some(bytes) = announced.filter(|&bytes| bytes > most) {
                return Err(Fault::Lasting(too_long(bytes, most)));
            }
            let mut data = Vec::with_capacity(announced.unwrap_or(0) as usize);
            response.body_mut().as_reader().take(most + 1).read_to_end(&mut data).map_err(|e| broken(&e))?;
            if data.len() as u64 > most {
                return Err(Fault::Lasting(format!("it holds more than the {most} bytes that are accepted here")));
            }
            // Bodies without a stated length end with their connection.
            return match announced {
                Some(bytes) if bytes != data.len() as u64 => Err(Fault::Passing(short(data.len() as u64, bytes), None)),
                _ => Ok(Some(data)),
            };
        };
        if status == 206 {
            let stated = header("content-range").and_then(content_range);
            let Some((start, end, total)) = stated else {
                return Err(Fault::Passing(format!("the range {range} was asked for, and one without a place was sent"), None));
            };
            let bytes = (end - start).saturating_add(1);
            let fits = match span {
                Span::From(first, wanted) => start == first && bytes == wanted,
                Span::Last(wanted) => bytes == wanted && total.is_none_or(|total| end + 1 == total),
                Span::All => false,
            };
            if !fits {
                // A part that is shorter is answered with what there is.
                if let Some(total) = total {
                    span.of(total, most).map_err(Fault::Lasting)?;
                }
                return Err(Fault::Passing(format!("the range {range} was asked for, and bytes {start} to {end} were sent"), None));
            }
            return exactly(&mut response, 0, bytes, announced).map(Some);
        }
        // The server knows no ranges, and sends all.
        let length = match (span, announced) {
            (_, Some(length)) => length,
            (Span::From(start, bytes), None) => start.saturating_add(bytes),
            _ => return Err(Fault::Lasting("its server knows no ranges, which the index of a shard needs".into())),
        };
        let (start, bytes) = span.of(length, most).map_err(Fault::Lasting)?;
        if start > MAX_SKIPPED {
            return Err(Fault::Lasting(format!(
                "its server knows no ranges, and would have to send {start} bytes before those that are needed; accepted are {MAX_SKIPPED} \
                 at most, or servers that answer `Range` with status 206"
            )));
        }
        exactly(&mut response, start, bytes, None).map(Some)
    }

    /// What an answer without the part means.
    fn refusal(&self, name: &str, status: u16, pause: Option<Duration>) -> Result<Option<Vec<u8>>, Fault> {
        match status {
            404 | 410 => Ok(None),
            // Object stores that are not to be listed answer so for a part that is not there.
            403 => {
                if describes(name) {
                    self.denied.store(true, Ordering::Relaxed);
                }
                Ok(None)
            }
            _ => Err(refused(status, pause)),
        }
    }

    /// Tries until one succeeds or fails for good, or the tries or their time are used up.
    fn tried<T>(&self, name: &str, limit: Duration, attempt: impl Fn(Instant) -> Result<T, Fault>) -> Result<T, String> {
        let begin = Instant::now();
        let mut pause = PAUSE;
        let mut tries = 0;
        loop {
            tries += 1;
            let (what, asked) = match attempt(begin + limit) {
                Ok(found) => return Ok(found),
                Err(Fault::Lasting(what)) => return Err(what),
                Err(Fault::Passing(what, asked)) => (what, asked),
            };
            let next = asked.map_or(pause, |asked| asked.max(pause));
            pause *= 4;
            let given_up = || self.given_up.load(Ordering::Relaxed);
            if tries == TRIES || begin.elapsed() + next >= limit || given_up() {
                return Err(format!("{what} ({tries} tries in {:.1} s)", begin.elapsed().as_secs_f64()));
            }
            tracing::debug!("{}: `{name}`: {what}; trying again in {:.1} s", self.url, next.as_secs_f64());
            std::thread::sleep(next);
            if given_up() {
                return Err(what);
            }
        }
    }
}

impl Parts for HttpParts {
    fn read(&self, name: &str, span: Span, most: u64) -> Result<Option<Vec<u8>>, String> {
        checked(name)?;
        let wanted = match span {
            Span::All => most,
            Span::Last(bytes) | Span::From(_, bytes) => bytes,
        };
        match span {
            _ if wanted > most => return Err(too_long(wanted, most)),
            Span::From(start, bytes) if start.checked_add(bytes).is_none() => {
                return Err(format!("{bytes} bytes from {start} are needed, beyond any part"));
            }
            // There is no range without bytes.
            Span::Last(0) | Span::From(_, 0) => return Ok(Some(Vec::new())),
            _ => {}
        }
        let described = describes(name);
        let limit = if described { self.limit.min(METADATA_LIMIT) } else { self.limit + Duration::from_secs(wanted / SLOWEST) };
        let data = self.tried(name, limit, |deadline| self.attempt(name, span, most, deadline))?;
        if described && data.is_some() {
            // The first counts.
            let _ = self.known.set(name.to_owned());
        }
        Ok(data)
    }

    /// Asks for the first byte of metadata that were read before.
    fn confirm(&self) -> Result<(), String> {
        let Some(known) = self.known.get() else { return Err("its metadata were not read".into()) };
        let asked = self.tried(known, self.limit.min(METADATA_LIMIT), |deadline| {
            let mut response = self.get(known, Some("bytes=0-0"), deadline)?;
            let (status, pause) = (response.status().as_u16(), retry_after(&response));
            drain(&mut response);
            if [200, 206].contains(&status) { Ok(()) } else { Err(refused(status, pause)) }
        });
        asked.map_err(|what| format!("`{known}`: {what}"))
    }

    fn give_up(&self, given_up: bool) {
        self.given_up.store(given_up, Ordering::Relaxed);
    }

    fn folders(&self, _: &str) -> Result<Vec<String>, String> {
        Err(UNLISTED.into())
    }

    fn lists(&self) -> bool {
        false
    }

    fn at_once(&self) -> usize {
        CONNECTIONS
    }

    fn denied(&self) -> bool {
        self.denied.load(Ordering::Relaxed)
    }

    fn requests(&self) -> u64 {
        self.requests.load(Ordering::Relaxed)
    }
}

/// Why a group without consolidated metadata is not read.
const UNLISTED: &str = "it is a group without consolidated metadata, and HTTP lists no groups; accepted are stores with `.zmetadata` (version 2) or \
                        `consolidated_metadata` in `zarr.json` (version 3), which `zarr.consolidate_metadata(STORE)` in Python writes. Of groups in \
                        a store, name the store, and variables as `archive.u = \"GROUP/NAME\"`";

fn is_https(url: &str) -> bool {
    url.split_once("://").is_some_and(|(scheme, _)| scheme.eq_ignore_ascii_case("https"))
}

/// The value of the header for the host of a URL, if it is set for this host.
fn authorization(url: &str, text: &str) -> Result<Option<String>, String> {
    let (host, value) = text
        .split_once(' ')
        .filter(|(host, value)| !host.is_empty() && !value.trim().is_empty() && value.bytes().all(|b| (b' '..=b'~').contains(&b)))
        .ok_or_else(|| {
            format!("{AUTHORIZATION} is not understood; accepted is \"HOST VALUE\", such as \"data.example.org Bearer TOKEN\"")
        })?;
    if !host.eq_ignore_ascii_case(authority(url)) {
        return Ok(None);
    }
    if !is_https(url) && !is_local(host_and_port(host).0) {
        return Err(format!("{AUTHORIZATION} is set for {host}, but its URL would send it unencrypted; accepted is `https`"));
    }
    Ok(Some(value.trim().to_owned()))
}

/// The connections of this process, kept for later requests. One that began encrypted is not led to one that is not.
fn agent(https: bool) -> Result<&'static Agent, String> {
    static AGENTS: [OnceLock<Result<Agent, String>>; 2] = [const { OnceLock::new() }; 2];
    let made = AGENTS[usize::from(https)].get_or_init(|| {
        let mut tls = TlsConfig::builder();
        // As OpenSSL and curl do: these instead of the usual ones.
        if let Ok(path) = var("SSL_CERT_FILE") {
            tls = tls.root_certs(certificates(Path::new(&path)).map_err(|what| format!("SSL_CERT_FILE = {path}: {what}"))?);
        }
        let config = Agent::config_builder()
            .http_status_as_error(false)
            .https_only(https)
            .max_redirects(REDIRECTS)
            .redirect_auth_headers(RedirectAuthHeaders::Never)
            .max_idle_connections(2 * CONNECTIONS)
            .max_idle_connections_per_host(CONNECTIONS)
            .user_agent(concat!("ridgewatch/", env!("CARGO_PKG_VERSION")))
            .accept_encoding("identity")
            .tls_config(tls.build());
        Ok(config.build().new_agent())
    });
    made.as_ref().map_err(Clone::clone)
}

fn certificates(path: &Path) -> Result<RootCerts, String> {
    let mut text = Vec::new();
    let file = ridgewatch_base::files::open(path).map_err(|e| e.to_string())?;
    file.take(MAX_CERTIFICATES).read_to_end(&mut text).map_err(|e| e.to_string())?;
    let mut found = Vec::new();
    for item in parse_pem(&text) {
        if let PemItem::Certificate(certificate) = item.map_err(|e| e.to_string())? {
            found.push(certificate);
        }
    }
    if found.is_empty() { Err("it holds no certificates in PEM".into()) } else { Ok(found.into()) }
}

/// A name of a part as the path of a URL.
fn encoded(name: &str) -> String {
    // Other characters may stand in a path too, but some object stores read `+` as a space.
    let kept = |byte: u8| byte.is_ascii_alphanumeric() || b"/-._~".contains(&byte);
    name.bytes().map(|byte| if kept(byte) { char::from(byte).to_string() } else { format!("%{byte:02X}") }).collect()
}

/// First and last byte, and the length of the whole, of `bytes A-B/C` or `bytes A-B/*`.
fn content_range(text: &str) -> Option<(u64, u64, Option<u64>)> {
    let (range, total) = text.strip_prefix("bytes ")?.split_once('/')?;
    let (start, end) = range.split_once('-')?;
    let (start, end) = (start.trim().parse().ok()?, end.trim().parse().ok()?);
    (start <= end).then_some((start, end, total.trim().parse().ok()))
}

/// Reads these bytes of a body.
fn exactly(response: &mut Response<ureq::Body>, skipped: u64, bytes: u64, announced: Option<u64>) -> Result<Vec<u8>, Fault> {
    if let Some(announced) = announced.filter(|&announced| announced != bytes) {
        return Err(Fault::Passing(format!("{bytes} bytes were asked for, and {announced} announced"), None));
    }
    let mut body = response.body_mut().as_reader();
    let passed = std::io::copy(&mut body.by_ref().take(skipped), &mut std::io::sink()).map_err(|e| broken(&e))?;
    let mut data = Vec::with_capacity(bytes as usize);
    body.by_ref().take(bytes).read_to_end(&mut data).map_err(|e| broken(&e))?;
    if data.len() as u64 != bytes {
        return Err(Fault::Passing(short(passed + data.len() as u64, skipped + bytes), None));
    }
    // A connection is used again once its answer has ended.
    if announced.is_some() {
        body.read(&mut [0]).map_err(|e| broken(&e))?;
    }
    Ok(data)
}

/// Reads what is left of a short answer, so that its connection can be used again.
fn drain(response: &mut Response<ureq::Body>) {
    // An error means that the connection is not used again.
    let _ = std::io::copy(&mut response.body_mut().as_reader().take(ERROR_BYTES), &mut std::io::sink());
}

/// Whether a part holds metadata.
fn describes(name: &str) -> bool {
    METADATA.contains(&name.rsplit('/').next().unwrap_or_default())
}

/// The pause that an answer asks for.
fn retry_after(response: &Response<ureq::Body>) -> Option<Duration> {
    let text = response.headers().get("retry-after")?.to_str().ok()?;
    text.trim().parse().ok().map(|seconds| Duration::from_secs(seconds).min(MAX_PAUSE))
}

/// The fault of an answer that neither holds a part nor says that there is none.
fn refused(status: u16, pause: Option<Duration>) -> Fault {
    match status {
        401 | 403 => Fault::Lasting(format!(
            "status {status}: its server asks for credentials; {AUTHORIZATION}=\"HOST VALUE\" sets the header `Authorization` for a host"
        )),
        404 | 410 => Fault::Lasting(format!("status {status}")),
        416 => Fault::Lasting("it is shorter than the range that is needed (status 416)".into()),
        408 | 425 | 429 | 500..=599 => Fault::Passing(format!("status {status}"), pause),
        _ => Fault::Lasting(format!("status {status}; accepted are 200, 206 and, if it is not stored, 404")),
    }
}

fn too_long(bytes: u64, most: u64) -> String {
    format!("it holds {bytes} bytes, more than the {most} that are accepted here")
}

fn short(found: u64, announced: u64) -> String {
    format!("the connection ended after {found} of {announced} bytes")
}

/// The fault of a body that could not be read to its end.
fn broken(error: &std::io::Error) -> Fault {
    Fault::Passing(format!("its body broke off: {error}"), None)
}

/// The fault of a request. URLs are left out: those of a redirect may hold secrets.
fn fault(error: &ureq::Error) -> Fault {
    use ureq::Error;
    let text = error.to_string();
    match error {
        Error::TooManyRedirects => Fault::Lasting(format!("it is redirected more than {REDIRECTS} times")),
        Error::RequireHttpsOnly(_) => Fault::Lasting("it is redirected from https to http, which is not followed".into()),
        Error::BadUri(_) | Error::Http(_) => Fault::Lasting("its URL, or one that it is redirected to, is not understood".into()),
        // Its text holds the header. The type within is of a crate that is not named here.
        Error::Protocol(_) if text.contains("location header") => {
            Fault::Lasting("it is redirected, but the header `Location` is missing or not understood".into())
        }
        Error::ConnectProxyFailed(_) => Fault::Passing("the proxy does not connect".into(), None),
        Error::Timeout(kind) => Fault::Passing(format!("no answer in time ({kind})"), None),
        Error::Tls(_) | Error::Rustls(_) | Error::Pem(_) => Fault::Lasting(untrusted(&text)),
        Error::Io(_) if text.contains("certificate") => Fault::Lasting(untrusted(&text)),
        _ => Fault::Passing(text, None),
    }
}

fn untrusted(text: &str) -> String {
    format!("no secure connection: {text}; certificates of other authorities are accepted from a file that SSL_CERT_FILE names")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn urls_are_told_from_paths_and_checked() {
        let is = |text: &str| is_url(Path::new(text));
        assert!(
            is("https://a.b/x.zarr")
                && is("HTTP://a")
                && !is("x.zarr")
                && is("s3://a/b")
                && !is("://a")
                && !is("/https/x")
                && !is("http:/a")
        );
        assert_eq!(checked_url("https://a.b:81/c d".replace(' ', "%20").as_str()), Ok("https://a.b:81/c%20d".into()));
        assert_eq!(checked_url("http://[::1]:8000/x.zarr//"), Ok("http://[::1]:8000/x.zarr".into()));
        for (url, shown, what) in [
            ("https://me:hunter2@a/x", "https://...", "names a user"),
            ("https://me:hun/ter2@a/x", "https://...", "has no host"),
            ("https://a/x?sig=hunter2", "https://a/x", "queries"),
            ("https://a/x?sig=hunter2@b", "https://...", "queries"),
            ("https://a/x#hunter2", "https://a/x", "queries"),
            ("https://a/*.zarr", "https://a/*.zarr", "is a pattern"),
            ("https://a/x y", "https://a/x y", "%20"),
            ("s3://a/x", "s3://a/x", "amazonaws.com"),
            ("https:///x", "https:///x", "has no host"),
        ] {
            let found = checked_url(url).unwrap_err();
            assert!(found.0 == shown && found.1.contains(what) && !found.1.contains("hunter2"), "{url}: {found:?}");
        }
    }

    #[test]
    fn a_credential_is_for_its_host_alone() {
        let of = |url: &str| authorization(url, "data.org Bearer abc");
        assert_eq!(of("https://data.org/x"), Ok(Some("Bearer abc".into())));
        assert_eq!((of("https://data.org.evil/x"), of("https://data.org:8443/x")), (Ok(None), Ok(None)));
        let said = of("http://data.org/x").unwrap_err();
        assert!(said.contains("unencrypted") && !said.contains("abc"), "{said}");
        for host in ["127.0.0.1:9", "127.0.0.1", "[::1]:9", "[::1]", "localhost", "LOCALHOST:9"] {
            assert_eq!(authorization(&format!("http://{host}/x"), &format!("{host} a")), Ok(Some("a".into())), "{host}");
        }
        for host in ["[::2]", "[fe80::1]:9", "localhost.evil", "127.0.0.1.evil:9", "127.evil"] {
            assert!(authorization(&format!("http://{host}/x"), &format!("{host} a")).is_err(), "{host}");
        }
        for odd in ["abc", " abc", "data.org ", "data.org a\nb"] {
            assert!(authorization("https://data.org/x", odd).is_err_and(|said| !said.contains("abc")), "{odd:?}");
        }
    }

    #[test]
    fn names_and_ranges_are_written_as_http_has_them() {
        assert_eq!(encoded("a b/ü?#%/0.0"), "a%20b/%C3%BC%3F%23%25/0.0");
        assert_eq!(encoded("u+v/c@1/0=0&!$'(),*;:-._~"), "u%2Bv/c%401/0%3D0%26%21%24%27%28%29%2C%2A%3B%3A-._~");
        assert_eq!(content_range("bytes 5-9/20"), Some((5, 9, Some(20))));
        assert_eq!(content_range("bytes 5-9/*"), Some((5, 9, None)));
        for odd in ["", "bytes */20", "bytes 9-5/20", "items 5-9/20", "bytes 5-/20"] {
            assert_eq!(content_range(odd), None, "{odd}");
        }
    }
}

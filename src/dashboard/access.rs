//! Who may see what: host, origin and token of a request.

use super::error::DashboardError;
use super::token::Token;
use axum::http::header::{AUTHORIZATION, HOST, HeaderMap, HeaderName, ORIGIN};
use axum::http::uri::{Authority, Uri};
use std::net::{IpAddr, SocketAddr};

/// Why a request is refused, for the one who asks.
pub(super) type Refused = &'static str;

const NO_TOKEN: Refused = "This page needs its token: open the address that ridgewatch printed.\n";
const HOST_REFUSED: Refused = "The host name of this address is not accepted: use localhost, or start ridgewatch with --allow-host and the name that the browser shows.\n";
const ORIGIN_REFUSED: Refused = "Pages of other origins are not served.\n";

/// What a token allows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Rights {
    /// To see frames, and to send commands.
    Steer,
    /// To see frames.
    Watch,
}

/// Checks requests.
#[derive(Debug)]
pub(super) struct Access {
    token: Token,
    watching: Token,
    /// Lower case.
    hosts: Vec<String>,
    address: SocketAddr,
}

impl Access {
    pub fn new(token: Token, hosts: Vec<String>, address: SocketAddr) -> Result<Self, DashboardError> {
        let hosts = hosts.iter().map(|host| host_name(host)).collect::<Result<_, _>>()?;
        Ok(Self { watching: token.watching(), token, hosts, address })
    }

    /// Refuses names that a stranger may have pointed at this machine (DNS rebinding).
    pub fn check_host(&self, headers: &HeaderMap) -> Result<(), Refused> {
        let host = only(headers, HOST).and_then(|host| host.parse::<Authority>().ok()).ok_or(HOST_REFUSED)?;
        if self.accepts(host.host()) { Ok(()) } else { Err(HOST_REFUSED) }
    }

    fn accepts(&self, host: &str) -> bool {
        let name = host.to_ascii_lowercase();
        let address = name.trim_start_matches('[').trim_end_matches(']').parse::<IpAddr>().map(|address| address.to_canonical());
        match address {
            // A browser that names an address reaches that address. Who listens for others is reached at addresses that are not known here.
            Ok(address) if address.is_loopback() || !self.address.ip().is_loopback() => true,
            _ => name == "localhost" || self.hosts.contains(&name),
        }
    }

    /// Refuses connections that a page of another origin opens. Programs that are no browser send no origin.
    pub fn check_origin(&self, headers: &HeaderMap) -> Result<(), Refused> {
        if !headers.contains_key(ORIGIN) {
            return Ok(());
        }
        let origin = only(headers, ORIGIN).and_then(|origin| origin.parse::<Uri>().ok()).ok_or(ORIGIN_REFUSED)?;
        let host = only(headers, HOST).and_then(|host| host.parse::<Authority>().ok()).ok_or(HOST_REFUSED)?;
        let name = origin.host().ok_or(ORIGIN_REFUSED)?;
        let default = if origin.scheme_str() == Some("https") { 443 } else { 80 };
        let is_same = name.eq_ignore_ascii_case(host.host()) && origin.port_u16().unwrap_or(default) == host.port_u16().unwrap_or(default);
        // Some proxies put a name of their own in place of the host that the browser sent. Under the same name, another port is another server.
        let is_renamed = !name.eq_ignore_ascii_case(host.host()) && self.hosts.iter().any(|host| name.eq_ignore_ascii_case(host));
        if is_same || is_renamed { Ok(()) } else { Err(ORIGIN_REFUSED) }
    }

    /// What the token in the query allows. A cookie would go to all servers of this host, whatever their port.
    pub fn check_token(&self, uri: &Uri) -> Result<Rights, Refused> {
        self.rights(given_token(uri))
    }

    /// As [`Self::check_token`]; programs may send the token as `Authorization: Bearer TOKEN`, which browsers never do by themselves.
    pub fn check_token_or_bearer(&self, uri: &Uri, headers: &HeaderMap) -> Result<Rights, Refused> {
        self.rights(given_token(uri).or_else(|| only(headers, AUTHORIZATION)?.strip_prefix("Bearer ")))
    }

    fn rights(&self, given: Option<&str>) -> Result<Rights, Refused> {
        match given {
            Some(given) if self.token.is(given) => Ok(Rights::Steer),
            Some(given) if self.watching.is(given) => Ok(Rights::Watch),
            _ => Err(NO_TOKEN),
        }
    }

    /// The token that only watches, for those who may steer.
    pub fn token_to_share(&self, rights: Rights) -> Option<&str> {
        (rights == Rights::Steer).then(|| self.watching.secret())
    }
}

/// The token of a request, right or wrong.
pub(super) fn given_token(uri: &Uri) -> Option<&str> {
    parameter(uri, "token")
}

/// A value of the query. Those of this server need no escapes.
pub(super) fn parameter<'a>(uri: &'a Uri, name: &str) -> Option<&'a str> {
    uri.query().unwrap_or_default().split('&').find_map(|part| part.strip_prefix(name)?.strip_prefix('='))
}

/// The name of a host as browsers send it, in lower case.
///
/// # Errors
/// Something else, such as what has a user, a port, a path or a scheme.
pub fn host_name(text: &str) -> Result<String, DashboardError> {
    let is_name = text.parse::<Authority>().is_ok_and(|parsed| parsed.host() == text);
    if is_name { Ok(text.to_ascii_lowercase()) } else { Err(DashboardError::HostName(text.to_owned())) }
}

/// Value of a header that may come once.
fn only(headers: &HeaderMap, name: HeaderName) -> Option<&str> {
    let mut values = headers.get_all(name).iter();
    values.next().filter(|_| values.next().is_none())?.to_str().ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::http::HeaderValue;

    fn access(hosts: &[&str], address: &str) -> Access {
        Access::new(Token::random().unwrap(), hosts.iter().map(|host| (*host).to_owned()).collect(), address.parse().unwrap()).unwrap()
    }

    fn headers(pairs: &[(HeaderName, &str)]) -> HeaderMap {
        pairs.iter().map(|(name, value)| (name.clone(), HeaderValue::from_str(value).unwrap())).collect()
    }

    #[test]
    fn hosts_of_the_loopback_and_allowed_ones_are_accepted() {
        let local = access(&["Portal.example.org"], "127.0.0.1:8577");
        let open = access(&[], "0.0.0.0:8577");
        for (host, by_local, by_open) in [
            ("localhost:8577", true, true),
            ("LOCALHOST", true, true),
            ("127.0.0.1:9000", true, true),
            ("[::1]:8577", true, true),
            ("portal.example.org", true, false),
            ("192.0.2.7:8577", false, true),
            ("evil.example.org:8577", false, false),
            ("localhost.evil.org", false, false),
            ("127.0.0.1.evil.org", false, false),
            ("127.0.0.1@evil.org", false, false),
            ("", false, false),
        ] {
            let headers = headers(&[(HOST, host)]);
            assert_eq!(local.check_host(&headers).is_ok(), by_local, "{host}");
            assert_eq!(open.check_host(&headers).is_ok(), by_open, "{host}");
        }
        assert!(local.check_host(&HeaderMap::new()).is_err());
        let twice: HeaderMap = {
            let mut twice = headers(&[(HOST, "localhost")]);
            twice.append(HOST, HeaderValue::from_static("evil.org"));
            twice
        };
        assert!(local.check_host(&twice).is_err());
        for odd in ["https://portal.example.org", "portal.example.org:443", "portal.example.org/", "a b", "me@portal.example.org", ""] {
            assert!(Access::new(Token::random().unwrap(), vec![odd.to_owned()], "127.0.0.1:1".parse().unwrap()).is_err(), "{odd}");
        }
    }

    #[test]
    fn only_the_own_origin_is_accepted() {
        let access = access(&["portal.example.org"], "127.0.0.1:8577");
        for (origin, host, accepted) in [
            ("http://127.0.0.1:8577", "127.0.0.1:8577", true),
            ("https://localhost", "localhost:443", true),
            ("http://localhost", "localhost", true),
            // Another server on this machine, maybe of another user.
            ("http://127.0.0.1:8578", "127.0.0.1:8577", false),
            ("http://localhost:8577", "127.0.0.1:8577", false),
            ("https://portal.example.org", "node17:8577", true),
            // Another server under the name of a proxy.
            ("http://portal.example.org:9000", "portal.example.org:8577", false),
            ("https://evil.example.org", "127.0.0.1:8577", false),
            ("null", "127.0.0.1:8577", false),
            ("file://", "127.0.0.1:8577", false),
        ] {
            let headers = headers(&[(ORIGIN, origin), (HOST, host)]);
            assert_eq!(access.check_origin(&headers).is_ok(), accepted, "{origin} {host}");
        }
        assert!(access.check_origin(&headers(&[(HOST, "127.0.0.1:8577")])).is_ok(), "no browser");
    }

    #[test]
    fn the_token_comes_by_query() {
        let access = access(&[], "127.0.0.1:8577");
        let token = access.token.secret().to_owned();
        let rights = |query: &str| access.check_token(&format!("/{query}").parse().unwrap());
        assert_eq!(rights(&format!("?token={token}")), Ok(Rights::Steer));
        assert_eq!(rights(&format!("?token={}", access.token_to_share(Rights::Steer).unwrap())), Ok(Rights::Watch));
        assert_eq!(access.token_to_share(Rights::Watch), None);
        let check = |query: &str| rights(query).is_ok();
        assert!(check(&format!("?token={token}")) && check(&format!("?a=1&token={token}")));
        assert!(!check("") && !check("?token=") && !check(&format!("?token={}", &token[1..])) && !check("?token=wrong"));
    }
}

//! Who is at the other end of a connection, and whose connection is closed when there are too many.

use std::collections::HashMap;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::time::Instant;

/// State ESTABLISHED in the system's tables. In others the user may be missing, which reads as 0.
const ESTABLISHED: &str = "01";
/// Bits of an IPv6 address that name its network.
const NETWORK: u128 = !(u64::MAX as u128);

/// Owner of a connection, for the shares of connections.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum Owner {
    /// A user of this machine, whatever the address: a user may take any address of 127.0.0.0/8.
    User(u32),
    /// Another machine, or the machines of an IPv6 network of 64 bits: whoever has one address of it can usually take all. Unknown users of this
    /// machine share one address.
    Address(IpAddr),
}

impl Owner {
    pub fn of(peer: IpAddr, user: Option<u32>) -> Self {
        let address = match peer.to_canonical() {
            address if address.is_loopback() => Ipv4Addr::LOCALHOST.into(),
            IpAddr::V6(address) => Ipv6Addr::from_bits(address.to_bits() & NETWORK).into(),
            address => address,
        };
        user.map_or(Self::Address(address), Self::User)
    }
}

/// Users whose processes hold the other ends of connections (peer, here). `None` if one is on another machine or not known.
///
/// The tables list all connections of the machine; one reading serves all that wait.
pub(crate) fn users_of(connections: &[(SocketAddr, SocketAddr)]) -> Vec<Option<u32>> {
    let plain = |address: &SocketAddr| SocketAddr::new(address.ip().to_canonical(), address.port());
    let mut users: HashMap<_, Option<u32>> = HashMap::new();
    for (peer, here) in connections {
        let (peer, here) = (plain(peer), plain(here));
        if peer.ip().is_loopback() || peer.ip() == here.ip() {
            users.insert((peer, here), None);
        }
    }
    for table in ["/proc/net/tcp", "/proc/net/tcp6"] {
        let lines = File::open(table).map(|file| BufReader::new(file).lines()).into_iter().flatten();
        for (local, remote, user) in lines.map_while(Result::ok).filter_map(|line| row(&line)) {
            users.entry((plain(&local), plain(&remote))).and_modify(|known| *known = Some(user));
        }
    }
    connections.iter().map(|(peer, here)| users.get(&(plain(peer), plain(here))).copied().flatten()).collect()
}

/// Local and remote address, and user, of an established connection.
fn row(line: &str) -> Option<(SocketAddr, SocketAddr, u32)> {
    let mut words = line.split_ascii_whitespace().skip(1);
    let (local, remote) = (address(words.next()?)?, address(words.next()?)?);
    if words.next()? != ESTABLISHED {
        return None;
    }
    Some((local, remote, words.nth(3)?.parse().ok()?))
}

/// An address in hexadecimal: words as this machine has them in memory, then the port.
fn address(text: &str) -> Option<SocketAddr> {
    let (ip, port) = text.split_once(':')?;
    let word = |at: usize| u32::from_str_radix(ip.get(8 * at..8 * at + 8)?, 16).ok().map(u32::to_ne_bytes);
    let ip = match ip.len() {
        8 => IpAddr::from(word(0)?),
        _ => {
            let words = [word(0)?, word(1)?, word(2)?, word(3)?];
            IpAddr::V6(Ipv6Addr::from_octets(words.as_flattened().try_into().ok()?))
        }
    };
    Some(SocketAddr::new(ip, u16::from_str_radix(port, 16).ok()?))
}

/// Index of the connection to close, from the owner of each, whether it has subscribed, and since when it took no message: of the owner with the
/// most connections, preferably one that has not subscribed, preferably the one that took nothing for longest.
pub(crate) fn displaced(connections: &[(Owner, bool, Instant)]) -> Option<usize> {
    let mut counts = HashMap::new();
    for (owner, ..) in connections {
        *counts.entry(owner).or_insert(0) += 1;
    }
    let most = *counts.values().max()?;
    let candidates = connections.iter().enumerate().filter(|(_, (owner, ..))| counts[owner] == most);
    candidates.min_by_key(|(_, (_, has_subscribed, idle_since))| (*has_subscribed, *idle_since)).map(|(index, _)| index)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn the_owner_with_the_most_connections_loses_one_without_subscription_or_the_idlest() {
        let begin = Instant::now();
        // Negative: has not subscribed. The first is idle for longest.
        let connection = |(at, n): (usize, &i32)| (Owner::User(n.unsigned_abs()), *n > 0, begin + Duration::from_secs(at as u64));
        for (there, gone) in [
            (&[1, 2, 2, 3][..], 1),
            (&[1, 1, 2, 2], 0),
            (&[3, 1, 2, 2, 1, 2], 2),
            (&[5], 0),
            (&[1, 1, -1, -1, 2], 2),
            (&[1, 2, -2, -1], 2),
            // Many connections of one owner do not displace a new one of another.
            (&[1, 1, 1, -2], 0),
        ] {
            let connections: Vec<_> = there.iter().enumerate().map(connection).collect();
            assert_eq!(displaced(&connections), Some(gone), "{there:?}");
        }
        // The first took a message just now.
        let served = [(Owner::User(1), true, begin + Duration::from_secs(9)), (Owner::User(1), true, begin)];
        assert_eq!(displaced(&served), Some(1));
        assert_eq!(displaced(&[]), None);
    }

    #[test]
    fn many_addresses_of_this_machine_displace_no_other_owner() {
        let loopback = |n: u8| IpAddr::from([127, 0, n, 7]);
        let (subscriber, begin) = (Owner::of(loopback(0), Some(1000)), Instant::now());
        for stranger in [Some(1001), None] {
            // All subscribe, each from a different address; the last address has the IPv6 form.
            let mapped = Ipv4Addr::new(127, 9, 9, 9).to_ipv6_mapped();
            let addresses = (1..255).map(loopback).chain([IpAddr::from(mapped)]);
            let connections: Vec<_> = [(subscriber, true, begin)]
                .into_iter()
                .chain(addresses.map(|address| (Owner::of(address, stranger), true, begin)))
                .collect();
            assert_eq!(displaced(&connections), Some(1), "{stranger:?}");
        }
        // A user is one owner at every address; another machine is another owner.
        assert_eq!(Owner::of("192.0.2.1".parse().unwrap(), Some(1000)), subscriber);
        assert_ne!(Owner::of("192.0.2.1".parse().unwrap(), None), Owner::of(loopback(1), None));
    }

    #[test]
    fn many_addresses_of_an_ipv6_network_displace_no_other_owner() {
        let of = |address: &str| Owner::of(address.parse().unwrap(), None);
        let (subscriber, begin) = (of("2001:db8:1:2::1"), Instant::now());
        let theirs = (1..255).map(|n| of(&format!("2001:db8:1:3:{n:x}:{n:x}::{n:x}")));
        let connections: Vec<_> = [subscriber].into_iter().chain(theirs).map(|owner| (owner, true, begin)).collect();
        assert_eq!(displaced(&connections), Some(1));
        // IPv4 addresses are counted one by one, in both forms.
        assert_eq!(of("::ffff:192.0.2.1"), of("192.0.2.1"));
        assert_ne!(of("::ffff:192.0.2.1"), of("::ffff:192.0.2.2"));
    }

    /// For every address of this machine.
    #[test]
    fn a_peer_of_this_machine_is_known_by_its_user() {
        let own = Some(rustix::process::geteuid().as_raw());
        for address in ["127.0.0.1:0", "[::1]:0", "[::]:0"] {
            let listener = std::net::TcpListener::bind(address).unwrap();
            let reached = if address == "[::]:0" { IpAddr::from([127, 0, 0, 1]) } else { listener.local_addr().unwrap().ip() };
            let peers: Vec<_> =
                (0..3).map(|_| std::net::TcpStream::connect((reached, listener.local_addr().unwrap().port())).unwrap()).collect();
            let accepted: Vec<_> = peers.iter().map(|_| listener.accept().unwrap()).collect();
            let pairs: Vec<_> = accepted.iter().map(|(stream, peer)| (*peer, stream.local_addr().unwrap())).collect();
            assert_eq!(users_of(&pairs), [own; 3], "{address}");
            let other = (peers[0].local_addr().unwrap(), "192.0.2.1:5577".parse().unwrap());
            assert_eq!(users_of(&[other, pairs[0]]), [None, own], "no such connection");
            drop(peers);
            assert_eq!(users_of(&pairs), [None; 3], "closed connections have no user");
        }
        assert_eq!(users_of(&[("192.0.2.7:1000".parse().unwrap(), "192.0.2.1:5577".parse().unwrap())]), [None], "of another machine");
    }
}

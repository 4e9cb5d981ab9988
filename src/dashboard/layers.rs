//! All layers of the newest frame of a run in another process. They are subscribed to while a page needs them, over a connection of their own, so
//! that no picture waits behind them, and the run makes none for pages that only look.

use super::hub::Hub;
use super::pixels::{CUT_OFF, NOT_COME, NOT_REACHED};
use super::received::decode_layers;
use crate::publish::LAYERS_TOPIC;
use bytes::Bytes;
use ridgewatch_zmtp::{SubscribeError, Subscriber};
use std::time::Duration;
use tokio::sync::watch;
use tokio::time::{Instant, sleep_until, timeout};

/// Time for which they are wanted after a page needed them.
const WANTED: Duration = Duration::from_secs(10);
/// Longest wait of a page for the first of them; pages wait for 5 seconds.
const LAYERS_WAIT: Duration = Duration::from_secs(4);
/// Maximum length of a message with them, in bytes: 11 layers of the largest picture that is sent, if nothing of it can be compressed.
const MAX_LAYERS_BYTES: usize = 192 << 20;
/// Shortest time between two attempts to subscribe.
const RECONNECT: Duration = Duration::from_millis(500);
/// Time until the next attempt after a connection that seems too slow for them, which would otherwise be busy with them for ever.
const RECONNECT_SLOW: Duration = Duration::from_secs(15);
/// A connection that ends after this time without any seems too slow.
const SLOW: Duration = Duration::from_secs(2);

/// What became of the wish for layers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Wish {
    /// Nobody has asked for them, or they have not come yet.
    Open,
    Met,
    /// The publisher is not reached.
    Unreached,
    /// The connection ended before any came, and not at once.
    CutOff,
}

/// Who needs layers, and whether there are any.
#[derive(Debug)]
pub(super) struct Layers {
    /// When a page last needed them.
    needed: watch::Sender<Option<Instant>>,
    wish: watch::Sender<Wish>,
}

impl Default for Layers {
    fn default() -> Self {
        Self { needed: watch::Sender::new(None), wish: watch::Sender::new(Wish::Open) }
    }
}

fn is_recent(needed: Option<Instant>) -> bool {
    needed.is_some_and(|at| at.elapsed() < WANTED)
}

impl Layers {
    /// Says that a page needs them. Waits a moment for the first, unless the publisher is not reached.
    pub async fn need(&self) {
        if !is_recent(*self.needed.borrow()) {
            // A link that seemed too slow waits for its next attempt.
            self.wish.send_if_modified(|wish| *wish != Wish::CutOff && std::mem::replace(wish, Wish::Open) != Wish::Open);
        }
        self.needed.send_replace(Some(Instant::now()));
        let _ = timeout(LAYERS_WAIT, self.wish.subscribe().wait_for(|wish| *wish != Wish::Open)).await;
    }

    /// Why there are none, in words.
    pub fn why_none(&self) -> &'static str {
        match *self.wish.borrow() {
            Wish::Open | Wish::Met => NOT_COME,
            Wish::Unreached => NOT_REACHED,
            Wish::CutOff => CUT_OFF,
        }
    }

    /// Waits until no page has needed them for a while.
    async fn unneeded(&self) {
        loop {
            // Not held while it is waited.
            let needed = *self.needed.borrow();
            match needed.filter(|_| is_recent(needed)) {
                Some(at) => sleep_until(at + WANTED).await,
                None => return,
            }
        }
    }
}

impl Hub {
    /// Follows the layers whenever a page needs them. Never ends.
    pub async fn follow_layers(&self) {
        let layers = &self.pixels.layers;
        let mut needed = layers.needed.subscribe();
        loop {
            if !is_recent(*layers.needed.borrow()) {
                self.pixels.forget_layers();
            }
            // Its sender is in the hub.
            let _ = needed.wait_for(|needed| is_recent(*needed)).await;
            let begin = Instant::now();
            let (wish, next) = match Subscriber::connect(self.endpoint(), &[LAYERS_TOPIC], MAX_LAYERS_BYTES).await {
                Ok(subscriber) => match self.take_while_needed(subscriber).await {
                    Ok(()) => (Wish::Open, begin + RECONNECT),
                    Err(error) => {
                        tracing::debug!("layers: {error}");
                        let is_slow = *layers.wish.borrow() != Wish::Met && begin.elapsed() > SLOW;
                        if is_slow { (Wish::CutOff, Instant::now() + RECONNECT_SLOW) } else { (Wish::Unreached, begin + RECONNECT) }
                    }
                },
                Err(error) => {
                    tracing::debug!("layers: {error}");
                    (Wish::Unreached, begin + RECONNECT)
                }
            };
            layers.wish.send_replace(wish);
            sleep_until(next).await;
        }
    }

    async fn take_while_needed(&self, mut subscriber: Subscriber) -> Result<(), SubscribeError> {
        let layers = &self.pixels.layers;
        // Those before may be of another run.
        self.pixels.forget_layers();
        layers.wish.send_replace(Wish::Open);
        loop {
            tokio::select! {
                received = subscriber.receive() => {
                    match self.take_layers(received?).await {
                        Ok(()) => drop(layers.wish.send_replace(Wish::Met)),
                        Err(problem) => self.complain(&problem),
                    }
                }
                () = layers.unneeded() => {
                    self.pixels.forget_layers();
                    return Ok(());
                }
            }
        }
    }

    async fn take_layers(&self, parts: Vec<Bytes>) -> Result<(), String> {
        let [topic, header, exr] =
            <[Bytes; 3]>::try_from(parts).map_err(|parts| format!("layers in {} parts; accepted: 3", parts.len()))?;
        if topic != LAYERS_TOPIC {
            return Err("a message of another topic than layers".to_owned());
        }
        let decoded = tokio::task::spawn_blocking(move || decode_layers(&header, &exr)).await.map_err(|error| error.to_string())?;
        let (frame, about) = decoded?;
        self.pixels.newest.receive(frame, about);
        Ok(())
    }
}

//! One browser: pictures at its pace, records, the state of the publisher, and its commands.

use super::hub::{self, Hub, Place};
use super::steering::Answer;
use axum::extract::ws::{CloseFrame, Message, WebSocket};
use bytes::Bytes;
use serde::Deserialize;
use serde_json::{Map, Value};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::oneshot;
use tokio::time::{Instant, MissedTickBehavior, interval, timeout};

/// Interval of messages about the publisher.
const STATE: Duration = Duration::from_secs(1);
/// Silence after which a browser is sent a ping. After as much again it is disconnected.
const SILENCE: Duration = Duration::from_secs(10);
/// Longest time for one message to be taken.
const STALL: Duration = Duration::from_secs(20);
/// Code of the end of a connection whose place another one took; the page does not come back by itself.
const DISPLACED: u16 = 4001;
/// Code of a message that is not understood (RFC 6455, 7.4.1).
const POLICY: u16 = 1008;

/// What the page says.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
enum Said {
    /// A picture was drawn.
    Drawn { ack: u64 },
    /// A change of the run. The answer has the number.
    Command { command: u64, set: Map<String, Value> },
}

/// A command whose answer has not come.
type Asked = Option<(u64, oneshot::Receiver<Answer>)>;

const ACCEPTED: &str = "a message that is not understood; accepted: {\"ack\":N}, {\"command\":N,\"set\":{...}}";

/// Why a connection ends. Errors of the network need no answer.
enum End {
    Gone,
    Closed(u16, &'static str),
}

enum Turn {
    Heard(Option<Result<Message, axum::Error>>),
    Answered(u64, Answer),
    Picture,
    Records,
    Tick,
}

/// Serves a browser until it leaves, is lost, or loses its place. One that may steer is told a token to share with those who may not.
pub(super) async fn serve(mut socket: WebSocket, hub: Arc<Hub>, token_to_share: Option<String>) {
    let place = hub.enter(token_to_share.is_some());
    let end = tokio::select! {
        end = talk(&mut socket, &hub, &place, token_to_share.as_deref()) => end,
        () = place.displaced.notified() => End::Closed(DISPLACED, "too many pages are open; those that only watch give way first"),
    };
    if let End::Closed(code, reason) = end {
        let close = Message::Close(Some(CloseFrame { code, reason: reason.into() }));
        let _ = timeout(STATE, socket.send(close)).await;
    }
}

async fn talk(socket: &mut WebSocket, hub: &Hub, place: &Place, token_to_share: Option<&str>) -> End {
    let (mut pictures, mut recorded) = (hub.picture.subscribe(), hub.recorded.subscribe());
    // What is there already is news to this browser.
    pictures.mark_changed();
    recorded.mark_changed();
    let mut ticks = interval(STATE);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    // Sequence of the picture that it is drawing.
    let mut drawing: Option<u64> = None;
    let (mut next_record, mut heard, mut pinged) = (0, Instant::now(), None);
    let mut asked: Asked = None;
    loop {
        let turn = tokio::select! {
            message = socket.recv() => Turn::Heard(message),
            (number, answer) = answered(&mut asked) => Turn::Answered(number, answer),
            // The hub outlives this.
            _ = pictures.changed(), if drawing.is_none() => Turn::Picture,
            _ = recorded.changed() => Turn::Records,
            _ = ticks.tick() => Turn::Tick,
        };
        let sent = match turn {
            Turn::Heard(Some(Ok(message))) => {
                (heard, pinged) = (Instant::now(), None);
                match message {
                    Message::Text(text) => match serde_json::from_str::<Said>(&text) {
                        Ok(Said::Drawn { ack }) => {
                            drawing = drawing.filter(|sequence| *sequence != ack);
                            place.is_active();
                            Ok(())
                        }
                        Ok(Said::Command { command, .. }) if token_to_share.is_none() => {
                            let why = "this address only watches; the one that ridgewatch printed first also steers".to_owned();
                            send(socket, hub::answer(command, &Answer::Refused(why))).await
                        }
                        Ok(Said::Command { command, .. }) if asked.is_some() => {
                            let why = "an earlier command of this page waits for its answer".to_owned();
                            send(socket, hub::answer(command, &Answer::Refused(why))).await
                        }
                        Ok(Said::Command { command, set }) => {
                            asked = Some((command, hub.wheel.command(set)));
                            Ok(())
                        }
                        Err(_) => return End::Closed(POLICY, ACCEPTED),
                    },
                    Message::Binary(_) => return End::Closed(POLICY, "a binary message; accepted: text"),
                    Message::Close(_) => return End::Gone,
                    // Pings are answered by the library.
                    Message::Ping(_) | Message::Pong(_) => Ok(()),
                }
            }
            Turn::Answered(number, answer) => send(socket, hub::answer(number, &answer)).await,
            Turn::Heard(_) => return End::Gone,
            Turn::Picture => {
                let newest = pictures.borrow_and_update().clone();
                match newest {
                    Some(picture) => {
                        drawing = Some(picture.sequence);
                        send(socket, picture.message.clone()).await
                    }
                    None => Ok(()),
                }
            }
            Turn::Records => match hub.records_from(next_record) {
                Some((message, next)) => {
                    next_record = next;
                    // There may be more, after whatever else is due.
                    recorded.mark_changed();
                    send(socket, message).await
                }
                None => Ok(()),
            },
            Turn::Tick if pinged.is_some_and(|at: Instant| at.elapsed() > SILENCE) => return End::Gone,
            Turn::Tick => {
                if heard.elapsed() > SILENCE && pinged.is_none() {
                    pinged = Some(Instant::now());
                    if timeout(STALL, socket.send(Message::Ping(Bytes::new()))).await.is_err() {
                        return End::Gone;
                    }
                }
                send(socket, hub.state(token_to_share)).await
            }
        };
        if sent.is_err() {
            return End::Gone;
        }
    }
}

/// The answer to the command that was asked. Waits for ever without one.
async fn answered(asked: &mut Asked) -> (u64, Answer) {
    let Some((number, answer)) = asked else { return std::future::pending().await };
    let answer = answer.await.unwrap_or_else(|_| Answer::Refused("the dashboard ends".to_owned()));
    let number = *number;
    *asked = None;
    (number, answer)
}

/// Sends a message, which the browser must take in time.
async fn send(socket: &mut WebSocket, message: Bytes) -> Result<(), ()> {
    match timeout(STALL, socket.send(Message::Binary(message))).await {
        Ok(Ok(())) => Ok(()),
        _ => Err(()),
    }
}

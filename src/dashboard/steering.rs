//! The way of commands from pages to the command socket of the run, and of the answers back.

use crate::run::SteeringState;
use crate::steer::{Outcome, SteerError, Steerer};
use serde::Serialize;
use serde_json::{Map, Value};
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::{mpsc, oneshot};
use tokio::time::{MissedTickBehavior, interval, sleep};

/// Commands that wait. A page has one at a time.
const MAX_WAITING: usize = 64;
/// Interval at which the socket is asked for the state, which others may change.
const LOOK: Duration = Duration::from_secs(1);
/// Shortest time between two attempts to reach the socket.
const RECONNECT: Duration = Duration::from_millis(500);
/// What those who only watch are told; the reason may name files of this machine.
const NOT_STEERED: &str = "its command socket is not reached; the page of those who may steer says why";
/// Shortest time between two commands, so that all pages together stay below what the socket accepts.
const SPACING: Duration = Duration::from_millis(15);

/// What becomes of a command, as a page is told.
#[derive(Debug, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Answer {
    Accepted(SteeringState),
    /// Why, in words.
    Refused(String),
}

type Request = (Map<String, Value>, oneshot::Sender<Answer>);

/// State of the way to the command socket.
#[derive(Debug, Clone, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Reach {
    Ready(SteeringState),
    /// Why the run is not steered.
    None(String),
}

/// Takes commands of pages.
#[derive(Debug)]
pub(super) struct Wheel {
    /// Connection file; `None`: no command is passed on.
    file: Option<PathBuf>,
    requests: mpsc::Sender<Request>,
    reach: Mutex<Reach>,
}

impl Wheel {
    /// With the requests that [`Self::drive`] takes.
    pub fn new(file: Option<PathBuf>) -> (Self, mpsc::Receiver<Request>) {
        let (requests, taken) = mpsc::channel(MAX_WAITING);
        let why =
            if file.is_some() { "its command socket was not reached yet" } else { "the dashboard or the run was started without --steer" };
        (Self { file, requests, reach: Mutex::new(Reach::None(why.to_owned())) }, taken)
    }

    pub fn reach(&self) -> Reach {
        self.reach.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// As a page is told, which may steer or only watch.
    pub fn reach_for(&self, may_steer: bool) -> Reach {
        match self.reach() {
            Reach::None(_) if !may_steer && self.file.is_some() => Reach::None(NOT_STEERED.to_owned()),
            reach => reach,
        }
    }

    fn set(&self, reach: Reach) {
        *self.reach.lock().unwrap_or_else(PoisonError::into_inner) = reach;
    }

    /// Passes a command on. The answer comes within some seconds.
    pub fn command(&self, set: Map<String, Value>) -> oneshot::Receiver<Answer> {
        let (send, receive) = oneshot::channel();
        if let Err(error) = self.requests.try_send((set, send)) {
            let (_, send) = error.into_inner();
            let _ = send.send(Answer::Refused("too many commands wait".to_owned()));
        }
        receive
    }

    /// Keeps a connection to the command socket. Never ends.
    pub async fn drive(&self, mut requests: mpsc::Receiver<Request>) {
        loop {
            let lost = match &self.file {
                Some(file) => match Steerer::connect(file).await {
                    Ok(mut steerer) => self.pass_on(&mut steerer, &mut requests).await,
                    Err(error) => error,
                },
                None => return self.refuse(&mut requests).await,
            };
            tracing::debug!("commands: {lost}");
            self.set(Reach::None(format!("its command socket cannot be reached ({lost})")));
            tokio::select! {
                () = sleep(RECONNECT) => {}
                () = self.refuse(&mut requests) => {}
            }
        }
    }

    /// Refuses all commands.
    async fn refuse(&self, requests: &mut mpsc::Receiver<Request>) {
        while let Some((_, reply)) = requests.recv().await {
            let Reach::None(why) = self.reach() else { continue };
            let _ = reply.send(Answer::Refused(format!("the run is not steered: {why}")));
        }
    }

    /// Passes commands on until the connection fails.
    async fn pass_on(&self, steerer: &mut Steerer, requests: &mut mpsc::Receiver<Request>) -> SteerError {
        let mut looks = interval(LOOK);
        looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            let (set, reply) = tokio::select! {
                // Its sender is in this structure.
                Some((set, reply)) = requests.recv() => (set, Some(reply)),
                _ = looks.tick() => (Map::new(), None),
            };
            let answer = match steerer.command(&set).await {
                Ok(Outcome::Accepted(state)) => {
                    self.set(Reach::Ready(state));
                    Answer::Accepted(state)
                }
                Ok(Outcome::Refused(refusal)) => Answer::Refused(refusal.text),
                Err(error) => {
                    let _ = reply.map(|reply| reply.send(Answer::Refused(format!("no answer came, and it may have been lost: {error}"))));
                    return error;
                }
            };
            if let Some(reply) = reply {
                let _ = reply.send(answer);
                sleep(SPACING).await;
            }
        }
    }
}

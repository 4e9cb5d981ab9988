//! One connection to the command socket: hello, then signed commands and signed answers.

use crate::run::{Steering, SteeringState};
use crate::setting::Refused;
use ridgewatch_wire::message::Key;
use ridgewatch_zmtp::Answer;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use std::sync::Arc;

/// Version of the messages.
pub(super) const VERSION: u32 = 1;
/// Bytes of a nonce, a challenge and a signature; twice as many digits.
const RANDOM: usize = 32;
/// Maximum number of characters of what was found, which a client may have made long.
const MAX_FOUND: usize = 300;

/// First message of either side.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Hello {
    pub hello: u32,
    /// Of the client.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub nonce: Option<String>,
    /// Of the socket.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub challenge: Option<String>,
}

/// A command as it is signed.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Said {
    /// Rises from command to command.
    pub number: u64,
    pub set: Map<String, Value>,
}

/// An answer as it is signed. `number` is missing where that of the command is not known.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Answered {
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub number: Option<u64>,
    #[serde(flatten)]
    pub outcome: Outcome,
}

/// What became of a command.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Outcome {
    /// The next frame shows it. The state after it.
    Accepted(SteeringState),
    /// It has changed nothing.
    Refused(Refusal),
}

/// Why a command was refused.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Refusal {
    /// Key or field at fault.
    pub field: String,
    /// What was found, with a verb.
    pub found: String,
    /// What is accepted.
    pub accepted: String,
    /// All of it in one sentence.
    pub text: String,
}

impl From<Refused> for Refusal {
    fn from(refused: Refused) -> Self {
        let short = |text: &str| text.chars().take(MAX_FOUND).collect::<String>();
        let short = Refused { key: short(&refused.key), found: short(&refused.found), ..refused };
        Self { text: short.to_string(), field: short.key, found: short.found, accepted: short.accepted }
    }
}

/// Key of a session, of which neither side alone chooses the numbers.
pub(super) fn session_key(key: &Key, nonce: &[u8; RANDOM], challenge: &[u8; RANDOM]) -> Key {
    key.derive(&[b"ridgewatch commands", nonce, challenge])
}

/// What is signed: a command cannot be passed off as an answer.
pub(super) const COMMAND: &[u8] = b"command";
pub(super) const ANSWER: &[u8] = b"answer";

pub(super) fn random() -> Result<[u8; RANDOM], getrandom::Error> {
    let mut bytes = [0; RANDOM];
    getrandom::fill(&mut bytes).map(|()| bytes)
}

pub(super) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// 32 bytes from 64 hexadecimal digits.
pub(super) fn from_hex(digits: &[u8]) -> Option<[u8; RANDOM]> {
    let digit = |c: u8| (c as char).to_digit(16).map(|digit| digit as u8);
    let (pairs, rest) = digits.as_chunks::<2>();
    let bytes = pairs.iter().map(|&[high, low]| Some(digit(high)? * 16 + digit(low)?)).collect::<Option<Vec<u8>>>()?;
    bytes.try_into().ok().filter(|_| rest.is_empty())
}

/// The socket's end of a connection.
pub(super) struct Session {
    key: Key,
    steering: Arc<Steering>,
    /// Key of the session, after the hello.
    session: Option<Key>,
    /// Number of the newest command.
    newest: u64,
}

impl Session {
    pub fn new(key: Key, steering: Arc<Steering>) -> Self {
        Self { key, steering, session: None, newest: 0 }
    }

    /// A session whose numbers no earlier one had, so that none of its commands is taken again.
    fn hello(&mut self, body: &[u8]) -> Result<Vec<u8>, Refused> {
        let accepted = "{\"hello\": 1, \"nonce\": \"64 hexadecimal digits\"}, or a signature and a command";
        let hello: Hello =
            serde_json::from_slice(body).map_err(|error| Refused::new("hello", format!("cannot be read ({error})"), accepted))?;
        if hello.hello != VERSION {
            return Err(Refused::new("hello", format!("is {}", hello.hello), VERSION.to_string()));
        }
        let nonce = hello.nonce.as_deref().and_then(|nonce| from_hex(nonce.as_bytes()));
        let nonce = nonce.ok_or_else(|| Refused::new("nonce", format!("is {:?}", hello.nonce), "64 hexadecimal digits"))?;
        let challenge =
            random().map_err(|error| Refused::new("hello", format!("came when there are no random numbers ({error})"), "it later"))?;
        (self.session, self.newest) = (Some(session_key(&self.key, &nonce, &challenge)), 0);
        Ok(json(&Hello { hello: VERSION, nonce: None, challenge: Some(hex(&challenge)) }))
    }

    /// The key of this session, if it has signed the command.
    fn verified(&self, signature: &[u8], body: &[u8]) -> Result<&Key, Refused> {
        let session =
            self.session.as_ref().ok_or_else(|| Refused::new("hello", "is missing", "a hello before commands, on each connection"))?;
        let given = from_hex(signature).filter(|given| session.verify(&[COMMAND, body], given).is_ok());
        let accepted = "that of this command with the key of the connection file and the challenge of this connection";
        given.map(|_| session).ok_or_else(|| Refused::new("signature", "is another one", accepted))
    }

    fn command(&mut self, body: &[u8]) -> Answered {
        let accepted = "{\"number\": N, \"set\": {KEY: VALUE, ...}}";
        let said: Said = match serde_json::from_slice(body) {
            Ok(said) => said,
            Err(error) => {
                let refused = Refused::new("command", format!("cannot be read ({error})"), accepted);
                return Answered { number: None, outcome: Outcome::Refused(refused.into()) };
            }
        };
        let taken = if said.number > self.newest {
            self.newest = said.number;
            self.steering.command(&said.set)
        } else {
            let accepted = format!("a number above {}: each command counts once", self.newest);
            Err(Refused::new("number", format!("is {}", said.number), accepted))
        };
        let outcome = taken.map_or_else(|refused| Outcome::Refused(refused.into()), Outcome::Accepted);
        Answered { number: Some(said.number), outcome }
    }
}

impl Answer for Session {
    fn answer(&mut self, parts: &[Vec<u8>]) -> (Vec<Vec<u8>>, bool) {
        let refused = match parts {
            [body] => match self.hello(body) {
                Ok(challenge) => return (vec![challenge], false),
                Err(refused) => refused,
            },
            [signature, body] => match self.verified(signature, body).cloned() {
                Ok(session) => {
                    let answer = json(&self.command(body));
                    return (vec![hex(&session.signature(&[ANSWER, &answer])).into_bytes(), answer], true);
                }
                Err(refused) => refused,
            },
            parts => {
                Refused::new("message", format!("has {} parts", parts.len()), "a hello (1 part), or a signature and a command (2 parts)")
            }
        };
        (vec![json(&Answered { number: None, outcome: Outcome::Refused(refused.into()) })], false)
    }
}

/// Our own structures have nothing that JSON cannot hold.
fn json(value: &impl Serialize) -> Vec<u8> {
    serde_json::to_vec(value).unwrap_or_default()
}

//! The other end of the command socket.

use super::SteerError;
use super::session::{ANSWER, Answered, COMMAND, Hello, Outcome, Said, VERSION, from_hex, hex, random, session_key};
use ridgewatch_wire::message::{ConnectionFile, Key};
use ridgewatch_zmtp::Requester;
use serde_json::{Map, Value};
use std::path::Path;
use std::time::Duration;

/// Longest wait for an answer.
const LIMIT: Duration = Duration::from_secs(5);
/// Maximum length of an answer, in bytes.
const MAX_ANSWER_BYTES: usize = 16 << 10;

/// A connection to the command socket of a run. It is not restored when it ends.
pub struct Steerer {
    requester: Requester,
    session: Key,
    number: u64,
}

impl Steerer {
    /// Connects to the socket of a connection file.
    ///
    /// # Errors
    /// A file that cannot be read or is not this user's alone, or a socket that cannot be reached or speaks another version.
    pub async fn connect(file: &Path) -> Result<Self, SteerError> {
        let ConnectionFile { address, key } = ConnectionFile::read(file)?;
        Self::connect_to(&address, &key).await
    }

    /// As [`Self::connect`], without a file.
    ///
    /// # Errors
    /// A socket that cannot be reached or speaks another version.
    pub async fn connect_to(endpoint: &str, key: &Key) -> Result<Self, SteerError> {
        let mut requester = Requester::connect(endpoint, MAX_ANSWER_BYTES).await?;
        let nonce = random().map_err(|error| SteerError::Random(error.to_string()))?;
        let hello = encode(&Hello { hello: VERSION, nonce: Some(hex(&nonce)), challenge: None })?;
        let parts = requester.ask(&[&hello], LIMIT).await?;
        let [body] = parts.as_slice() else { return Err(SteerError::Answer(format!("a hello of {} parts", parts.len()))) };
        let challenge = serde_json::from_slice::<Hello>(body).ok().and_then(|hello| from_hex(hello.challenge?.as_bytes()));
        let challenge = challenge.ok_or_else(|| SteerError::Answer(String::from_utf8_lossy(body).into_owned()))?;
        Ok(Self { requester, session: session_key(key, &nonce, &challenge), number: 0 })
    }

    /// Sends a command and returns what became of it. One that sets nothing asks for the state.
    ///
    /// # Errors
    /// There is no answer, or it is not of this socket. The connection is not to be used any more then.
    pub async fn command(&mut self, set: &Map<String, Value>) -> Result<Outcome, SteerError> {
        self.number += 1;
        let body = encode(&Said { number: self.number, set: set.clone() })?;
        let signature = hex(&self.session.signature(&[COMMAND, &body]));
        let parts = self.requester.ask(&[signature.as_bytes(), &body], LIMIT).await?;
        let understood = |body| serde_json::from_slice::<Answered>(body).map_err(|error| SteerError::Answer(error.to_string()));
        match parts.as_slice() {
            // Not signed, since the socket does not take this session for its own.
            [body] => match understood(body)?.outcome {
                Outcome::Refused(refusal) => Err(SteerError::Answer(refusal.text)),
                Outcome::Accepted(_) => Err(SteerError::Answer("it is not signed".into())),
            },
            [signature, body] => {
                let signature = from_hex(signature).ok_or_else(|| SteerError::Answer("its signature has no 64 digits".into()))?;
                self.session.verify(&[ANSWER, body], &signature)?;
                let answered = understood(body)?;
                let is_mine = answered.number.is_none_or(|number| number == self.number);
                if is_mine { Ok(answered.outcome) } else { Err(SteerError::Answer(format!("it is of command {:?}", answered.number))) }
            }
            parts => Err(SteerError::Answer(format!("{} parts", parts.len()))),
        }
    }
}

fn encode(value: &impl serde::Serialize) -> Result<Vec<u8>, SteerError> {
    serde_json::to_vec(value).map_err(|error| SteerError::Answer(error.to_string()))
}

//! Recorded logs: reads topics and messages from MCAP files.
//!
//! A file is read as a stream, so the memory used depends on the largest chunk and not on the size
//! of the file. Only [`Log::load`] holds a whole log, for comparisons.

mod coverage;

use std::{
    fs::File,
    io::{BufReader, ErrorKind, Read},
    path::{Path, PathBuf},
};

use mcap::{
    McapError,
    sans_io::{LinearReaderOptions, MessageReadEvent, MessageReader},
};

use coverage::Coverage;

/// The longest record that is read, in bytes. A message on the wire must not be larger either.
const RECORD_LIMIT: usize = 1 << 30;

/// A recorded topic: one name and one type.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Topic {
    /// The topic name as recorded.
    pub(crate) name: String,
    /// The type name as ROS writes it, such as `sensor_msgs/msg/LaserScan`.
    pub(crate) type_name: String,
}

/// One recorded message.
#[derive(Debug)]
pub(crate) struct Message {
    /// The index into the log's topics.
    pub(crate) topic: usize,
    /// The time of recording, in nanoseconds of the recorder's clock.
    pub(crate) time: u64,
    /// The serialized message.
    pub(crate) data: Vec<u8>,
}

/// The contents of a log, without its messages.
#[derive(Clone, Debug)]
pub(crate) struct Survey {
    /// The path of the log.
    pub(crate) path: PathBuf,
    /// The topics, in the order of their first messages.
    pub(crate) topics: Vec<Topic>,
    /// The number of messages.
    pub(crate) messages: u64,
    /// The sum of the messages' sizes in bytes.
    pub(crate) bytes: u64,
    /// The size of the largest message in bytes.
    pub(crate) largest: u64,
    /// The time from the earliest to the latest message, in nanoseconds.
    pub(crate) duration: u64,
    /// The damage that ends the log early, if only the part before it was requested.
    pub(crate) damage: Option<String>,
    /// Messages of a damaged log that no checksum covers.
    pub(crate) unverified: u64,
}

/// The part of a damaged log that is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Part {
    /// Nothing: a damaged log is an error.
    Nothing,
    /// The messages before the damage, if a checksum covers all of them.
    Verified,
    /// The messages before the damage, verified or not.
    Unverified,
}

/// The reason why a log cannot be read.
#[derive(Debug, thiserror::Error)]
pub(crate) enum LogError {
    #[error("cannot open the log {path}: {source}")]
    Open { path: PathBuf, source: std::io::Error },
    #[error("cannot read the log {path}: {source}")]
    Read { path: PathBuf, source: std::io::Error },
    #[error("{path} is not an MCAP log: it does not begin with the magic number")]
    NoLog { path: PathBuf },
    #[error("{path} is damaged: {source}; {}", whole(*messages, *unverified, *seconds))]
    Damaged { path: PathBuf, messages: u64, unverified: u64, seconds: f64, source: McapError },
    #[error("{path} changed while it was read: fewer messages are whole than at the start")]
    Changed { path: PathBuf },
    #[error("{path} holds no messages")]
    Empty { path: PathBuf },
}

/// Describes which part of a damaged log can be read.
fn whole(messages: u64, unverified: u64, seconds: f64) -> String {
    match (messages, unverified) {
        (0, _) => "no message before that is whole".to_owned(),
        (_, 0) => format!(
            "the {messages} messages ({seconds:.1} s) before that are whole, and `axon play --incomplete` \
             publishes them"
        ),
        _ => format!(
            "of the {messages} messages ({seconds:.1} s) before that {unverified} are covered by no checksum \
             that was right, and may be wrong; `axon play --incomplete --unverified` publishes all of them"
        ),
    }
}

impl Survey {
    /// Reads the log once from start to end and verifies its checksums.
    ///
    /// # Errors
    /// [`LogError::Damaged`] if a part of the log is missing or does not match its checksum. Other
    /// errors if the file cannot be read, is no MCAP log, or holds no messages.
    pub(crate) fn of(path: &Path) -> Result<Self, LogError> {
        Self::of_part(path, Part::Nothing)
    }

    /// As [`Survey::of`], but reads this part of a damaged log.
    ///
    /// # Errors
    /// [`LogError::Damaged`] if the log is damaged and `part` cannot be read from it.
    pub(crate) fn of_part(path: &Path, part: Part) -> Result<Self, LogError> {
        let (mut survey, damage) = Self::read(path)?;
        let Some(source) = damage else {
            return if survey.messages > 0 {
                Ok(survey)
            } else {
                Err(LogError::Empty { path: survey.path })
            };
        };
        let wanted = match part {
            Part::Nothing => false,
            Part::Verified => survey.unverified == 0,
            Part::Unverified => true,
        };
        if wanted && survey.messages > 0 {
            survey.damage = Some(source.to_string());
            return Ok(survey);
        }
        Err(LogError::Damaged {
            path: survey.path,
            messages: survey.messages,
            unverified: survey.unverified,
            seconds: survey.duration as f64 / 1e9,
            source,
        })
    }

    /// Reads the messages before the first damage. Returns the damage, too.
    fn read(path: &Path) -> Result<(Self, Option<McapError>), LogError> {
        let mut survey = Self {
            path: path.to_owned(),
            topics: Vec::new(),
            messages: 0,
            bytes: 0,
            largest: 0,
            duration: 0,
            damage: None,
            unverified: 0,
        };
        let (mut first, mut last) = (u64::MAX, 0);
        let mut messages = Messages::open(path, Vec::new(), Checks::Whole)?;
        let damage = loop {
            let message = match messages.advance() {
                Ok(Some(message)) => message,
                Ok(None) => break None,
                Err(End::Read(source)) => {
                    return Err(LogError::Read { path: path.to_owned(), source });
                }
                Err(End::Damage(_)) if !messages.coverage.is_log() => {
                    return Err(LogError::NoLog { path: path.to_owned() });
                }
                Err(End::Damage(error)) => break Some(error),
            };
            survey.messages += 1;
            survey.bytes += message.data.len() as u64;
            survey.largest = survey.largest.max(message.data.len() as u64);
            (first, last) = (first.min(message.time), last.max(message.time));
        };
        survey.duration = last.saturating_sub(first);
        survey.unverified = damage.as_ref().map_or(0, |error| messages.coverage.unverified(error));
        survey.topics = messages.topics;
        Ok((survey, damage))
    }

    /// Returns the surveyed messages in the order of the file, with indexes into this survey's
    /// topics.
    pub(crate) fn messages(
        &self,
    ) -> Result<impl Iterator<Item = Result<Message, LogError>> + Send + use<>, LogError> {
        let mut messages = Messages::open(&self.path, self.topics.clone(), Checks::Chunks)?;
        let mut left = self.messages;
        Ok(std::iter::from_fn(move || {
            left = left.checked_sub(1)?;
            let ended = match messages.advance() {
                Ok(Some(message)) => return Some(Ok(message)),
                ended => ended,
            };
            left = 0;
            let path = messages.path.clone();
            Some(Err(match ended {
                Err(End::Read(source)) => LogError::Read { path, source },
                _ => LogError::Changed { path },
            }))
        }))
    }
}

/// A whole log in memory.
#[derive(Debug)]
pub(crate) struct Log {
    /// The contents without the messages.
    pub(crate) survey: Survey,
    /// The messages of each topic, in the order of the file.
    pub(crate) payloads: Vec<Vec<Vec<u8>>>,
}

impl Log {
    /// Reads every message into memory.
    pub(crate) fn load(path: &Path) -> Result<Self, LogError> {
        let survey = Survey::of(path)?;
        let mut payloads = vec![Vec::new(); survey.topics.len()];
        for message in survey.messages()? {
            let message = message?;
            payloads[message.topic].push(message.data);
        }
        Ok(Self { survey, payloads })
    }
}

/// The checksums that are compared.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Checks {
    /// The checksum of each chunk, before its first message is returned.
    Chunks,
    /// The checksums of the chunks and of the data section.
    Whole,
}

/// The reason why no further message can be read.
#[derive(Debug)]
enum End {
    /// The file cannot be read.
    Read(std::io::Error),
    /// The file can be read, but the log is not complete.
    Damage(McapError),
}

struct Messages {
    path: PathBuf,
    file: BufReader<File>,
    reader: MessageReader,
    coverage: Coverage,
    topics: Vec<Topic>,
}

impl Messages {
    fn open(path: &Path, topics: Vec<Topic>, checks: Checks) -> Result<Self, LogError> {
        let file =
            File::open(path).map_err(|source| LogError::Open { path: path.to_owned(), source })?;
        let options = LinearReaderOptions::default()
            .with_record_length_limit(RECORD_LIMIT)
            .with_prevalidate_chunk_crcs(true)
            .with_validate_data_section_crc(checks == Checks::Whole);
        Ok(Self {
            path: path.to_owned(),
            file: BufReader::new(file),
            reader: MessageReader::new_with_options(options),
            coverage: Coverage::default(),
            topics,
        })
    }

    /// Returns the next message, or `None` at the end of a complete log.
    fn advance(&mut self) -> Result<Option<Message>, End> {
        let message = loop {
            match self.reader.next_event().transpose().map_err(End::Damage)? {
                None => return Ok(None),
                Some(MessageReadEvent::Message(message)) => break message,
                Some(MessageReadEvent::ReadRequest(length)) => self.fill(length)?,
            }
        };
        self.coverage.message();
        let type_name = message.channel.schema.as_ref().map_or("", |s| s.name.as_str());
        let name = message.channel.topic.as_str();
        let known = self.topics.iter().position(|t| t.name == name && t.type_name == type_name);
        let topic = known.unwrap_or_else(|| {
            self.topics.push(Topic { name: name.to_owned(), type_name: type_name.to_owned() });
            self.topics.len() - 1
        });
        Ok(Some(Message { topic, time: message.log_time, data: message.data.into_owned() }))
    }

    /// Reads up to `length` bytes of the file.
    fn fill(&mut self, length: usize) -> Result<(), End> {
        let room = self.reader.insert(length);
        let read = loop {
            match self.file.read(room) {
                Ok(read) => break read,
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => return Err(End::Read(error)),
            }
        };
        self.coverage.read(&room[..read]);
        self.reader.notify_read(read);
        Ok(())
    }
}

#[cfg(test)]
mod tests;

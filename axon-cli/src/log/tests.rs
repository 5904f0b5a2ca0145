use std::{collections::BTreeMap, io::Write};

use mcap::records::op;

use super::*;

const RECORDED: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/data/mit-csail.mcap");

fn file(bytes: &[u8]) -> tempfile::NamedTempFile {
    let mut file = tempfile::NamedTempFile::new().expect("temporary file");
    file.write_all(bytes).expect("write");
    file
}

#[test]
fn a_file_that_is_no_log_is_an_error_that_names_it() {
    for bytes in [&b""[..], b"not a log", b"\x89MCAP0\r\n", &[0xff; 4096]] {
        let file = file(bytes);
        let error = Survey::of(file.path()).expect_err("refused").to_string();
        assert!(error.contains(&*file.path().to_string_lossy()), "{error}");
    }
    let missing = Path::new("/nonexistent/log.mcap");
    assert!(matches!(Survey::of(missing), Err(LogError::Open { .. })));
}

#[test]
fn a_log_cut_anywhere_is_an_error_and_its_whole_part_is_readable() {
    let whole = std::fs::read(RECORDED).expect("the recorded log");
    let log = Log::load(Path::new(RECORDED)).expect("the recorded log");
    let mut found = 0;
    for cut in (0..whole.len()).step_by(whole.len() / 37) {
        let file = file(&whole[..cut]);
        let error = Survey::of(file.path()).expect_err("a cut log");
        let LogError::Damaged { messages, .. } = error else {
            assert!(Survey::of_part(file.path(), Part::Verified).is_err(), "cut at {cut}: {error}");
            continue;
        };
        if messages == 0 {
            assert!(error.to_string().contains("no message before that is whole"), "{error}");
            continue;
        }
        assert!(error.to_string().contains("--incomplete"), "{error}");
        let part = Survey::of_part(file.path(), Part::Verified).expect("the part before the cut");
        assert!(messages >= found && part.messages == messages && part.damage.is_some());
        let mut heads = vec![0; part.topics.len()];
        for message in part.messages().expect("opens") {
            let message = message.expect("a whole message");
            let topic = &part.topics[message.topic];
            let same = log.survey.topics.iter().position(|t| t == topic).expect("recorded");
            assert_eq!(message.data, log.payloads[same][heads[message.topic]]);
            heads[message.topic] += 1;
        }
        assert_eq!(heads.iter().sum::<usize>() as u64, messages);
        found = messages;
    }
    assert!(found > 5_000, "the last cut leaves nearly all: {found}");
}

#[test]
fn no_message_of_a_chunk_with_a_wrong_checksum_is_handed_out() {
    for compression in [None, Some(mcap::Compression::Zstd)] {
        let bytes = chunks_of_ten(3, compression);
        // The checksum follows two times and the uncompressed size in the chunk's header.
        let header = chunk_header(&bytes, 1);
        let mut wrong = bytes.clone();
        wrong[header + 24] ^= 1;
        let file = file(&wrong);
        let error = Survey::of(file.path()).expect_err("a wrong checksum");
        assert!(matches!(error, LogError::Damaged { messages: 10, .. }), "{error}");
        let part = Survey::of_part(file.path(), Part::Verified).expect("the first chunk");
        assert_eq!(part.messages().expect("opens").filter(Result::is_ok).count(), 10);
        assert!(Survey::of(self::file(&bytes).path()).is_ok());
    }
}

#[test]
fn damage_in_the_first_chunk_is_not_called_a_false_format() {
    for compression in [None, Some(mcap::Compression::Zstd)] {
        let mut bytes = chunks_of_ten(3, compression);
        let header = chunk_header(&bytes, 0);
        bytes[header + 24] ^= 1;
        let file = file(&bytes);
        for part in [Part::Nothing, Part::Verified, Part::Unverified] {
            let error = Survey::of_part(file.path(), part).expect_err("nothing is whole");
            assert!(matches!(error, LogError::Damaged { messages: 0, .. }), "{error}");
            let said = error.to_string();
            assert!(said.contains("is damaged: Chunk CRC failed"), "{said}");
            assert!(!said.contains("--incomplete"), "there is nothing to publish: {said}");
        }
    }
}

#[test]
fn messages_that_no_checksum_covers_are_not_called_whole() {
    let whole = without_chunks(10, true);
    assert_eq!(Survey::of(file(&whole).path()).expect("a whole log").messages, 10);
    let mut flipped = whole.clone();
    // A message's payload follows its channel, its sequence number and two times.
    let payload = record(&flipped, op::MESSAGE, 7) + 2 + 4 + 8 + 8;
    flipped[payload] ^= 1;
    // The first log has no checksum and has lost its end. The second is cut before its checksum.
    let none = without_chunks(10, false);
    let cuts = [&none[..none.len() - 1], &whole[..whole.len() / 2]];
    for bytes in [&flipped[..], cuts[0], cuts[1]] {
        let file = file(bytes);
        for part in [Part::Nothing, Part::Verified] {
            let error = Survey::of_part(file.path(), part).expect_err("unverified");
            let LogError::Damaged { messages, unverified, .. } = error else { panic!("{error}") };
            assert!(messages > 0 && unverified == messages, "{error}");
            let said = error.to_string();
            assert!(
                said.contains("--incomplete --unverified") && !said.contains("whole"),
                "{said}"
            );
        }
        let part = Survey::of_part(file.path(), Part::Unverified).expect("with another word");
        assert_eq!(part.unverified, part.messages);
    }
}

#[test]
fn a_verified_checksum_covers_the_records_before_it() {
    // The log has no chunks, and it is damaged after the data section, whose checksum was compared before.
    let whole = without_chunks(10, true);
    let cut = file(&whole[..whole.len() - 1]);
    assert_eq!(Survey::of_part(cut.path(), Part::Verified).expect("verified").messages, 10);
    // The checksum of the data section is wrong, and the chunks are correct.
    let mut bytes = chunks_of_ten(3, None);
    let end = record(&bytes, op::DATA_END, 0);
    bytes[end] ^= 1;
    let chunks = file(&bytes);
    let part = Survey::of_part(chunks.path(), Part::Verified).expect("verified by chunks");
    assert!(part.messages == 30 && part.damage.is_some(), "{part:?}");
    // The log is the same, but the second chunk has no checksum.
    let second = record(&bytes, op::CHUNK, 1);
    bytes[second + 24..second + 28].fill(0);
    let error = Survey::of_part(file(&bytes).path(), Part::Verified).expect_err("ten are not");
    assert!(matches!(error, LogError::Damaged { messages: 30, unverified: 10, .. }), "{error}");
}

#[test]
fn a_file_that_cannot_be_read_is_not_called_damaged() {
    let folder = tempfile::tempdir().expect("a folder");
    let error = Survey::of(folder.path()).expect_err("a folder");
    assert!(matches!(error, LogError::Read { .. }), "{error}");
}

#[test]
fn a_log_that_shrinks_between_survey_and_replay_is_an_error() {
    let bytes = chunks_of_ten(3, None);
    let file = file(&bytes);
    let survey = Survey::of(file.path()).expect("a whole log");
    file.as_file().set_len(chunk_header(&bytes, 2) as u64).expect("truncate");
    let read: Vec<_> = survey.messages().expect("opens").collect();
    assert_eq!(read.iter().filter(|message| message.is_ok()).count(), 20);
    assert!(read.last().expect("an error").is_err());
}

/// Returns a log of `count` chunks with ten messages each.
fn chunks_of_ten(count: u64, compression: Option<mcap::Compression>) -> Vec<u8> {
    let options = mcap::WriteOptions::new().compression(compression);
    written(options.calculate_data_section_crc(true), count * 10)
}

/// Returns a log of `count` messages that are in no chunk.
fn without_chunks(count: u64, checksum: bool) -> Vec<u8> {
    let options = mcap::WriteOptions::new().use_chunks(false);
    written(options.calculate_data_section_crc(checksum), count)
}

/// Returns a log of `count` messages, with ten in each chunk if it has chunks.
fn written(options: mcap::WriteOptions, count: u64) -> Vec<u8> {
    let mut writer = options.create(std::io::Cursor::new(Vec::new())).expect("writer");
    let channel = writer.add_channel(0, "/t", "cdr", &BTreeMap::new()).expect("channel");
    for number in 0..count {
        let header = mcap::records::MessageHeader {
            channel_id: channel,
            sequence: number as u32,
            log_time: number,
            publish_time: number,
        };
        writer.write_to_known_channel(&header, &number.to_le_bytes()).expect("message");
        if number % 10 == 9 {
            writer.flush().expect("end of a chunk");
        }
    }
    writer.finish().expect("finish");
    writer.into_inner().into_inner()
}

/// Returns the offset of the body of chunk `index`.
fn chunk_header(bytes: &[u8], index: usize) -> usize {
    record(bytes, op::CHUNK, index)
}

/// Returns the offset of the body of record `index` among the records with operation code `code`.
fn record(bytes: &[u8], code: u8, index: usize) -> usize {
    let mut at = mcap::MAGIC.len();
    let mut seen = 0;
    loop {
        let body = at + 9;
        let length = bytes[at + 1..body].try_into().expect("eight bytes");
        if bytes[at] == code {
            if seen == index {
                return body;
            }
            seen += 1;
        }
        at = body + u64::from_le_bytes(length) as usize;
    }
}

#[test]
fn a_record_of_absurd_length_is_refused_without_allocating_it() {
    let mut bytes = mcap::MAGIC.to_vec();
    bytes.push(0x05);
    bytes.extend_from_slice(&(1_u64 << 62).to_le_bytes());
    let error = Survey::of(file(&bytes).path()).expect_err("refused");
    assert!(matches!(error, LogError::Damaged { messages: 0, .. }), "{error}");
}

#[test]
fn the_recorded_log_reads_as_its_attribution_says() {
    let log = Log::load(Path::new(RECORDED)).expect("the recorded log");
    assert_eq!(log.survey.messages, 5_964);
    assert_eq!((log.survey.duration as f64 / 1e9).round(), 424.0);
    let scans = log
        .survey
        .topics
        .iter()
        .position(|t| t.name == "/scan" && t.type_name == "sensor_msgs/msg/LaserScan")
        .expect("the laser's topic");
    assert_eq!(log.payloads[scans].len(), 1_988);
    let bytes: usize = log.payloads.iter().flatten().map(Vec::len).sum();
    assert_eq!(bytes as u64, log.survey.bytes);
}

#[test]
fn channels_of_one_topic_and_type_are_one_topic() {
    let mut writer = mcap::Writer::new(std::io::Cursor::new(Vec::new())).expect("writer");
    let schema = writer.add_schema("a/msg/B", "ros2msg", b"").expect("schema");
    for callerid in ["one", "two"] {
        let metadata = BTreeMap::from([("callerid".to_owned(), callerid.to_owned())]);
        let channel = writer.add_channel(schema, "/t", "cdr", &metadata).expect("channel");
        let header = mcap::records::MessageHeader {
            channel_id: channel,
            sequence: 1,
            log_time: 1,
            publish_time: 1,
        };
        writer.write_to_known_channel(&header, callerid.as_bytes()).expect("message");
    }
    writer.finish().expect("finish");
    let file = file(&writer.into_inner().into_inner());
    let log = Log::load(file.path()).expect("log");
    assert_eq!(log.survey.topics.len(), 1);
    assert_eq!(log.payloads, [[b"one".to_vec(), b"two".to_vec()]]);
}

// A program that speaks ROS 2's topics over eProsima Fast DDS, without ROS: serialised messages
// as they are, no generated code. Built and run by tests/test_ros2_processes.py.
//
//   peer DOMAIN sub SECONDS TOPIC TYPE FILE [TOPIC TYPE FILE ...]
//       listens until it has heard of each topic, or so long; each FILE gets the last message,
//       standard output the numbers of messages
//   peer DOMAIN pub SECONDS HZ TOPIC TYPE FILE [TOPIC TYPE FILE ...]
//       sends the files' bytes, with the present time as their (first) header's stamp
// What ends in tf_static is kept for those who come later, sent once, and asked for like that.
#include <atomic>
#include <chrono>
#include <cstring>
#include <fstream>
#include <iostream>
#include <iterator>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>

using namespace eprosima::fastdds::dds;
using Payload = eprosima::fastrtps::rtps::SerializedPayload_t;
using Bytes = std::vector<char>;
using Clock = std::chrono::steady_clock;

// CDR bytes, header included, as the value of any type.
class Raw : public TopicDataType
{
public:
    explicit Raw(const std::string& name)
    {
        setName(name.c_str());
        m_typeSize = 8 << 20;
        m_isGetKeyDefined = false;
        auto_fill_type_object(false);
        auto_fill_type_information(false);
    }
    bool serialize(void* data, Payload* payload) override
    {
        const Bytes& bytes = *static_cast<Bytes*>(data);
        std::memcpy(payload->data, bytes.data(), bytes.size());
        payload->length = bytes.size();
        payload->encapsulation = CDR_LE;
        return true;
    }
    bool deserialize(Payload* payload, void* data) override
    {
        static_cast<Bytes*>(data)->assign(payload->data, payload->data + payload->length);
        return true;
    }
    std::function<uint32_t()> getSerializedSizeProvider(void* data) override
    {
        return [data] { return static_cast<uint32_t>(static_cast<Bytes*>(data)->size()); };
    }
    void* createData() override { return new Bytes; }
    void deleteData(void* data) override { delete static_cast<Bytes*>(data); }
    bool getKey(void*, eprosima::fastrtps::rtps::InstanceHandle_t*, bool) override { return false; }
};

class Listener : public DataReaderListener
{
public:
    void on_data_available(DataReader* reader) override
    {
        Bytes bytes;
        SampleInfo info;
        while (reader->take_next_sample(&bytes, &info) == ReturnCode_t::RETCODE_OK)
        {
            if (info.valid_data)
            {
                std::lock_guard<std::mutex> guard(lock);
                const std::string text(bytes.begin(), bytes.end());
                if (text.find(kept) == std::string::npos) continue;
                last = bytes;
                ++count;
            }
        }
    }
    std::mutex lock;
    Bytes last;
    int count = 0;
    std::string kept;  // messages without it are another's
};

static Topic* topic_of(DomainParticipant* member, const std::string& name, const std::string& type)
{
    TypeSupport(new Raw(type)).register_type(member);
    return member->create_topic(name, type, TOPIC_QOS_DEFAULT);
}

static bool is_kept(const std::string& topic)
{
    return topic.size() > 9 && topic.compare(topic.size() - 9, 9, "tf_static") == 0;
}

static int listen(DomainParticipant* member, double seconds, int n, char** names)
{
    DataReaderQos qos;
    qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
    qos.history().depth = 5;
    qos.endpoint().history_memory_policy =
        eprosima::fastrtps::rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
    std::vector<Listener> listeners(n / 3);
    Subscriber* subscriber = member->create_subscriber(SUBSCRIBER_QOS_DEFAULT);
    for (int i = 0; i + 2 < n; i += 3)
    {
        // The other process says transforms on the same topics; ours are of the frame "table".
        if (std::string(names[i + 1]).find("TFMessage") != std::string::npos)
        {
            listeners[i / 3].kept = "table";
        }
        qos.durability().kind =
            is_kept(names[i]) ? TRANSIENT_LOCAL_DURABILITY_QOS : VOLATILE_DURABILITY_QOS;
        subscriber->create_datareader(
            topic_of(member, names[i], names[i + 1]), qos, &listeners[i / 3]);
    }
    const auto end = Clock::now() + std::chrono::milliseconds(static_cast<int>(1000 * seconds));
    bool waits = true;
    while (waits && Clock::now() < end)
    {
        std::this_thread::sleep_for(std::chrono::milliseconds(50));
        waits = false;
        for (Listener& one : listeners)
        {
            std::lock_guard<std::mutex> guard(one.lock);
            waits = waits || one.count == 0;
        }
    }
    for (int i = 0; i + 2 < n; i += 3)
    {
        Listener& one = listeners[i / 3];
        std::lock_guard<std::mutex> guard(one.lock);
        std::ofstream(names[i + 2], std::ios::binary).write(one.last.data(), one.last.size());
        std::cout << one.count << (i + 5 < n ? " " : "");
    }
    std::cout << std::endl;
    return 0;
}

// ``at``: where in the bytes the stamp is: a TFMessage begins with how many transforms it has.
static void stamp_now(Bytes& message, size_t at)
{
    const auto now = std::chrono::system_clock::now().time_since_epoch();
    const auto ns = std::chrono::duration_cast<std::chrono::nanoseconds>(now).count();
    const int32_t seconds = static_cast<int32_t>(ns / 1000000000);
    const uint32_t rest = static_cast<uint32_t>(ns % 1000000000);
    std::memcpy(message.data() + at, &seconds, 4);
    std::memcpy(message.data() + at + 4, &rest, 4);
}

static int publish(DomainParticipant* member, double seconds, double hz, int n, char** names)
{
    DataWriterQos qos;
    qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
    qos.history().depth = 1;
    qos.publish_mode().kind = ASYNCHRONOUS_PUBLISH_MODE;
    qos.endpoint().history_memory_policy =
        eprosima::fastrtps::rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
    Publisher* publisher = member->create_publisher(PUBLISHER_QOS_DEFAULT);
    std::vector<DataWriter*> writers;
    std::vector<Bytes> messages;
    for (int i = 0; i + 2 < n; i += 3)
    {
        std::ifstream file(names[i + 2], std::ios::binary);
        messages.emplace_back(std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>());
        qos.durability().kind =
            is_kept(names[i]) ? TRANSIENT_LOCAL_DURABILITY_QOS : VOLATILE_DURABILITY_QOS;
        writers.push_back(publisher->create_datawriter(topic_of(member, names[i], names[i + 1]), qos));
    }
    const auto end = Clock::now() + std::chrono::duration<double>(seconds);
    auto next = Clock::now();
    int count = 0;
    for (; Clock::now() < end; ++count)
    {
        for (size_t i = 0; i < writers.size(); ++i)
        {
            const std::string type = names[3 * i + 1];
            if (!is_kept(names[3 * i]) || count == 0)
            {
                stamp_now(messages[i], type.find("TFMessage") == std::string::npos ? 4 : 8);
                writers[i]->write(&messages[i]);
            }
        }
        next += std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(1 / hz));
        std::this_thread::sleep_until(next);
    }
    std::cout << count << std::endl;
    return 0;
}

int main(int argc, char** argv)
{
    if (argc < 7)
    {
        return 2;
    }
    // Not by shared memory: what another version of Fast DDS left there would crash this one.
    DomainParticipantQos qos;
    qos.transport().use_builtin_transports = false;
    qos.transport().user_transports.push_back(
        std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>());
    DomainParticipant* member =
        DomainParticipantFactory::get_instance()->create_participant(std::stoi(argv[1]), qos);
    if (member == nullptr)
    {
        return 1;
    }
    const double seconds = std::stod(argv[3]);
    if (std::string(argv[2]) == "sub")
    {
        return listen(member, seconds, argc - 4, argv + 4);
    }
    return publish(member, seconds, std::stod(argv[4]), argc - 5, argv + 5);
}
